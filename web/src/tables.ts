// Answers without a server: the dictionary, then the text tower, then whole segments.

import { type Answer, type Clicked, type Source, answered, painted } from "./answers";
import { type Dictionary, plainly, singulars } from "./dictionary";
import type { Geometry, Place } from "./geometry";
import type { EverydayRule, PartRule } from "./manifest";
import { partScores, withParts } from "./parts";
import { type Language, shownSplats } from "./language";
import { type Question, type Thing, understood } from "./questions";
import { type Presence, hasColor, isDoubtful, isPart, isPartAlone, peakOf, presenceOf, strengthsOf, thingOfPart } from "./rules";
import type { Kinds } from "./kinds";
import type { Segments } from "./segments";
import { type Spelling, compounds } from "./spelling";
import type { Stage } from "./stage";
import type { Description } from "./tower";
import type { TowerLoader } from "./tower-loader";

export class Tables implements Source {
  readonly examples: string[];
  readonly #shown: Uint32Array;

  constructor(
    readonly stage: Stage,
    readonly geometry: Geometry,
    readonly language: Language,
    readonly segments: Segments | null,
    /** How parts are cut, and the words that name them; null where they are answered by segments. */
    readonly cuts: (PartRule & { words: EverydayRule }) | null,
    readonly dictionary: Dictionary,
    readonly loader: TowerLoader | null,
    readonly kinds: Kinds,
    /** Null in pages that were published without English words. */
    readonly spelling: Spelling | null,
    /** Whether the encoder knows English words alone. */
    readonly englishOnly: boolean,
  ) {
    geometry.hidden = segments?.hidden ?? null;
    this.#shown = shownSplats(geometry.opacities, geometry.rule.evidence_faint);
    dictionary.rank(language, this.#shown);
    this.examples = dictionary.examples(4);
  }

  complete(text: string): string[] {
    return this.dictionary.complete(text);
  }

  async answer(prompt: string, color: string): Promise<Answer | null> {
    if (prompt.split('"').length % 2 === 0) return this.#unanswered(prompt, color, '"', "Expected quotation marks in pairs, found an odd number.", []);
    const question = understood(prompt, this.dictionary.grammar);
    const { things, beyond, left, state } = question;
    const plain = things.length === 1 && !things[0].color && !beyond && !left && !state;
    if (plain && this.dictionary.has(prompt)) return this.#mended(prompt, prompt, color);
    if (beyond) return this.#beyond(question, prompt, color);
    if (left || things.length === 0) {
      const quoted = ` (“${left || prompt.trim()}”)`;
      return unread(await this.#plain(plainly(prompt) || prompt.trim(), prompt, color), `not understood${quoted}: asked for as one thing, in these words`);
    }
    const answers: Answer[] = [];
    for (const thing of things) {
      const answer = await this.#thing(thing, prompt, color);
      if (!answer) return null;
      answers.push(answer);
    }
    const answer = answers.length === 1 ? answers[0] : this.#united(answers, question, prompt, color);
    return state ? doubtful(answer, `the answer is the thing: “${state}” is a state, which photos may not tell`) : answer;
  }

  /** What asks for more than things is not answered; its things are offered. */
  #beyond({ things, beyond }: Question, prompt: string, color: string): Answer {
    const named = things.map(({ text, color: own }) => [own, text || (own && "things")].filter(Boolean).join(" "));
    const offers = [...new Set(named.filter(Boolean).map((name) => this.spelling?.singular(name) ?? name))];
    return this.#unanswered(prompt, color, beyond, `This page finds single things. “${beyond}” needs lexsplat view.`, offers);
  }

  #unanswered(prompt: string, color: string, beyond: string, note: string, offers: string[]): Answer {
    const found = { phrase: prompt, from: "page", scores: new Float32Array(this.geometry.count), places: [], presence: "unsure" as const };
    return answered(prompt, color, { ...found, threshold: this.geometry.rule.threshold, note, unknown: true, beyond, offers });
  }

  async #thing({ text, color: own, exact }: Thing, prompt: string, color: string): Promise<Answer | null> {
    if (exact) return this.#plain(text.toLowerCase(), prompt, color);
    if (text && !own) {
      const unseen = this.dictionary.grammar.match("with_attribute", text)?.[2];
      const answer = await this.#mended(text.toLowerCase(), prompt, color);
      return unseen ? doubtful(answer, `“${unseen}” is not looked for by itself`) : answer;
    }
    const { threshold } = this.geometry.rule;
    const phrase = [own, text || (own ? "things" : "any object")].filter(Boolean).join(" ");
    const none = { scores: new Float32Array(this.geometry.count), presence: "no" as const, places: [] };
    const kind = text ? singulars(text).find((form) => this.kinds.has(form)) : "";
    const found = kind === undefined ? null : this.kinds.find(kind, own, null);
    return answered(prompt, color, { phrase, from: "objects", threshold, ...(found ?? none) });
  }

  /** Several answers as one. */
  #united(parts: Answer[], { together }: Question, prompt: string, color: string): Answer {
    const order: Presence[] = ["no", "unsure", "yes"];
    const places = parts.map(({ presence }) => order.indexOf(presence));
    const presence = order[together ? Math.min(...places) : Math.max(...places)];
    const bare = ({ phrase: words }: Answer): string => words.toLowerCase().split(" ").filter((word) => !this.dictionary.grammar.has("colors", word)).join(" ");
    const isOneNoun = !together && presence === "yes" && new Set(parts.map(bare)).size === 1; // red or green apple
    const shown = presence === "no" ? parts : parts.filter((part) => part.presence === "yes" || (part.presence === "unsure" && !isOneNoun));
    const scores = shown[0].scores.slice();
    for (const part of shown.slice(1)) part.scores.forEach((score, i) => (scores[i] = Math.max(scores[i], score)));
    const lacking = parts.filter((part) => part.presence === "no").map((part) => `${part.unknown ? "not found" : "not in this scene"}: “${part.phrase}”`);
    const note = [...parts.map((part) => part.note), ...lacking].filter(Boolean).join("; ");
    const phrase = parts.map((part) => part.phrase).join(together ? " and " : " or ");
    const unknown = parts.some((part) => part.unknown);
    return answered(prompt, color, { phrase, from: parts[0].from, scores, presence, threshold: parts[0].threshold, note, unknown, parts: shown });
  }

  /** The answer to a thing, its typing errors mended. */
  async #mended(text: string, prompt: string, color: string): Promise<Answer | null> {
    if (!this.spelling) return this.#asked(text, prompt, color);
    const phrase = plainly(text);
    if (this.dictionary.find(text) >= 0) return this.#asked(text, prompt, color).then((answer) => this.#inOtherWords(answer, phrase, prompt, color));
    for (const { phrase: meant, note } of this.spelling.meant(phrase)) {
      const answer = await this.#asked(meant, prompt, color);
      if (answer && answer.presence !== "no") return { ...answer, note };
    }
    const answer = await this.#asked(text, prompt, color);
    const other = await this.#inOtherWords(answer, phrase, prompt, color);
    if (other !== answer) return other;
    const strange = this.englishOnly ? this.spelling.strange(phrase) : [];
    if (strange.length === 0) return answer;
    const listed = strange.slice(0, 3).map((word) => `“${word.slice(0, 40)}”`).join(", ");
    return doubtful(answer, `the bundled encoder knows English words alone, not ${listed}`);
  }

  /** What is not surely here, with a compound word split or joined where the scene holds that (lexsplat.queries.meaning). */
  async #inOtherWords(answer: Answer | null, text: string, prompt: string, color: string): Promise<Answer | null> {
    if (!answer || answer.presence === "yes") return answer;
    const phrase = this.spelling?.singular(text) ?? text;
    const isHere = async (words: string): Promise<Answer | null> => {
      const found = await this.#plain(words, prompt, color, true);
      return found?.presence === "yes" ? found : null;
    };
    for (const { words, head } of compounds(phrase, (word) => this.dictionary.grammar.has("in_compounds", word))) {
      const found = await isHere(words);
      if (found && (!head || (await isHere(head)))) return { ...found, note: [found.note, `“${phrase}” is asked for as “${words}”`].filter(Boolean).join("; ") };
    }
    return answer;
  }

  /** The answer to a text, for what was typed. */
  async #asked(text: string, prompt: string, color: string): Promise<Answer | null> {
    // As in Python, words behind "something" stay as they are: something with leaves.
    const kept = this.dictionary.find(text) >= 0 || text.startsWith("something ");
    const thing = kept ? text : (this.spelling?.singular(plainly(text)) ?? text);
    const first = await this.#plain(thing, prompt, color);
    const isPlural = first?.presence === "no" && first.phrase.toLowerCase() !== plainly(text);
    const own = isPlural ? await this.#plain(plainly(text), prompt, color, true) : null;
    const plain = own?.presence === "yes" ? own : first;
    const kind = plain && singulars(plainly(text)).find((form) => this.kinds.has(form));
    const members = kind ? this.kinds.find(kind, "", plain.scores) : null;
    return members ? { ...plain!, phrase: kind!, ...members } : plain;
  }

  /** The answer to a phrase by its own relevancy, or by the pixels of things of its name if it tells a color that language does not find. */
  async #plain(text: string, prompt: string, color: string, isOwn = false): Promise<Answer | null> {
    const plain = await this.#byLanguage(text, prompt, color, isOwn);
    const told = plain && plain.presence !== "yes" && this.segments ? this.#colorsTold(plain.phrase) : [];
    if (!plain || told.length === 0 || (this.cuts && isPart(plain.phrase, this.cuts.words))) return plain;
    const inColor = this.kinds.inColors(await this.#listedAs(plain.phrase, told, prompt), told, plain.scores);
    return inColor ? { ...plain, ...inColor } : plain;
  }

  /** The places in the list of what a phrase names without its color: by its noun, or else by what that selects. */
  async #listedAs(phrase: string, told: string[], prompt: string): Promise<number[]> {
    const words = phrase.toLowerCase().split(" ");
    const named = this.kinds.named(singulars(words.at(-1)!));
    if (named.length) return named;
    const out = words.map((word, n) => n < words.length - 1 && told.includes(word.replace("grey", "gray")));
    const joins = (n: number): boolean => ["and", "or"].includes(words[n]) && [out[n - 1], out[n + 1]].includes(true);
    const bare = words.filter((_, n) => !out[n] && !joins(n)).join(" ");
    const answer = await this.#plain(bare, prompt, "");
    return answer?.presence === "yes" ? this.kinds.covered(this.#seen(answer.scores, answer.threshold, this.segments!)) : [];
  }

  /** `isOwn` words are not asked for in the singular. */
  async #byLanguage(text: string, prompt: string, color: string, isOwn: boolean): Promise<Answer | null> {
    const known = isOwn && !this.dictionary.has(text) ? -1 : this.dictionary.find(text);
    if (known >= 0) {
      const own = this.language.scores(this.dictionary.table(known));
      const presence = this.dictionary.presence(known);
      const phrase = this.dictionary.phrases[known];
      return answered(prompt, color, { phrase, from: "dictionary", ...(await this.#whole(phrase, own, presence)) });
    }
    const phrase = plainly(text) || text;
    const tower = await this.loader?.load();
    if (!tower) return null;
    const described = tower.describe(phrase);
    const own = this.language.scores(described.table);
    const thing = thingOfPart(phrase, described.rule);
    const noun = (thing || phrase).toLowerCase().split(" of ")[0].split(/\s+/).at(-1)!;
    const isGone = described.rule.gone.includes(this.spelling?.singular(noun) ?? noun);
    const presence = isGone ? "no" : this.#presence(phrase, own, described, thing ? tower.describe(thing) : null);
    const found = await this.#whole(phrase, own, presence);
    const certain = !thing || found.presence !== "yes" || !described.fits || !this.segments;
    const doubt = certain ? {} : this.#doubt(phrase, this.#seen(found.scores, found.threshold, this.segments!), described);
    return answered(prompt, color, { phrase, from: "text tower", ...found, ...doubt });
  }

  /** As `lexsplat.queries.presence` has it: parts at segments, all else at objects. */
  #presence(phrase: string, own: Float32Array, described: Description, thing: Description | null): Presence {
    const { heights, best, rule, places, colored } = described;
    if (this.#shown.length === 0) return "no";
    if (!this.segments || !places || !colored) {
      const peak = peakOf(own, this.language, this.#shown, this.geometry.rule);
      return presenceOf(strengthsOf(heights, peak, best, rule), rule.yes, rule.no);
    }
    if (isPart(phrase, rule)) {
      this.#parts ??= this.segments.distributions(this.language);
      const strengths = strengthsOf(heights, this.#parts, best, rule);
      if (!thing) return presenceOf(strengths, rule.yes_segment, rule.no_segment);
      const held = strengthsOf(thing.heights, places, thing.compared, rule).some((value) => value >= rule.no_segment);
      const there = strengthsOf(thing.heights, this.#parts, thing.compared, rule);
      const at = held ? strengths.filter((_, place) => there[place] >= rule.at_thing) : [];
      return presenceOf(at, rule.yes_part, rule.no_part);
    }
    return hasColor(phrase, rule)
      ? presenceOf(strengthsOf(heights, places, colored, rule), rule.yes_colored, rule.no)
      : presenceOf(strengthsOf(heights, places, best, rule), rule.yes_segment, rule.no_segment);
  }
  #parts: Float32Array | null = null;

  /** By segments, something would always be taken: what is not here keeps the scores of single splats. */
  async #whole(phrase: string, own: Float32Array, presence: Presence) {
    const { threshold } = this.geometry.rule;
    if (!this.segments || presence === "no") return { scores: own, own, presence, threshold };
    const whole = this.segments.scores(own);
    if (!this.cuts) return { scores: whole, own, presence, threshold };
    const { words, held } = this.cuts;
    const { grammar } = this.dictionary;
    const parts = isPartAlone(phrase, words) ? await this.#ofObjects(phrase, whole, this.segments, held) : null;
    let scores = parts?.scores ?? (await this.#cut(phrase, own, whole, this.segments, this.cuts)) ?? whole;
    const splats = this.#seen(scores, threshold, this.segments);
    const opacity = splats.reduce((sum, i) => sum + this.geometry.opacities[i], 0);
    if (splats.length && opacity < this.geometry.rule.evidence_faint * splats.length) return { scores: own, own, presence: "no" as const, threshold };
    const sure = this.#hasColor(phrase, splats, held) && parts?.presence !== "unsure";
    if (presence === "yes" && sure && !isPart(phrase, words) && !isPartAlone(phrase, words)) {
      const noun = phrase.toLowerCase().split(" of ")[0].split(" ").at(-1)!;
      const masses = this.segments?.masses ?? this.geometry.opacities;
      const named = this.kinds.named(singulars(noun)).filter((place) => {
        const { name } = this.kinds.entry(place);
        if (grammar.has("stuff", name)) return false;
        return name === phrase.toLowerCase() || !this.#isQualified(phrase) || this.kinds.isMostly(place, splats, masses);
      });
      const [isSurface, carries] = ["surfaces", "carriers"].map((list) => (name: string): boolean => grammar.has(list, name));
      scores = this.kinds.completed(scores, splats, named, singulars(noun), isSurface, carries);
    }
    return { scores, own, ...parts, presence: presence === "yes" && !sure ? ("unsure" as const) : presence, threshold };
  }

  /** Whether what is selected may have the color and the name that a phrase tells; true if no color or quality is told. */
  #hasColor(phrase: string, splats: number[], share: number): boolean {
    const { grammar } = this.dictionary;
    const told = this.#colorsTold(phrase);
    const holding = this.kinds.holding(splats, share);
    const [last, ...before] = phrase.toLowerCase().split(" ").reverse();
    if (holding.length === 0 || (told.length === 0 && !before.some((word) => grammar.has("qualities", word)))) return true;
    const isNamed = (name: string): boolean => name.split(" ").at(-1) === last;
    if (this.kinds.names.some(isNamed) && !holding.some(({ name }) => isNamed(name))) return false;
    if (told.length === 0) return true;
    const seen = holding.flatMap((entry) => entry.seen_colors ?? []);
    const pairs = [...told.map((color) => [color, color]), ...grammar.list("near_colors").map((pair) => pair.split(" "))];
    if (!pairs.some(([a, b]) => (told.includes(a) && seen.includes(b)) || (told.includes(b) && seen.includes(a)))) return false;
    const whole = this.kinds.covered(splats).map((place) => this.kinds.entry(place)); // not only a part: a light belly
    return holding.some((entry) => whole.includes(entry) || told.some((color) => entry.colors?.includes(color)));
  }

  #isQualified(phrase: string): boolean {
    const before = phrase.toLowerCase().split(" ").slice(0, -1);
    return before.some((word) => this.dictionary.grammar.has("qualities", word));
  }

  /** The colors that a phrase tells of a thing. */
  #colorsTold(phrase: string): string[] {
    const before = phrase.toLowerCase().replace("grey", "gray").split(" ").slice(0, -1);
    return before.filter((word) => this.dictionary.grammar.has("told_colors", word));
  }

  /** A part without its thing, as that part of each object that has much of what its name selects; null if none has it. */
  async #ofObjects(part: string, whole: Float32Array, segments: Segments, share: number) {
    const taken = new Set(this.#seen(whole, this.geometry.rule.threshold, segments));
    const holding = this.kinds.holding([...taken], share);
    const things = holding.filter(({ name }) => !this.dictionary.grammar.has("surfaces", name));
    const found = new Map<string, Answer>();
    for (const name of new Set((things.length ? things : holding).map((entry) => entry.name))) {
      if (this.dictionary.grammar.has("stuff", name)) continue;
      const answer = await this.#plain(`${name} ${part}`, part, "");
      const chosen = answer && answer.presence !== "no" ? this.#seen(answer.scores, answer.threshold, segments) : [];
      if (2 * chosen.filter((i) => taken.has(i)).length > chosen.length) found.set(name, answer!);
    }
    if (found.size === 0) return null;
    const certain = [...found].filter(([, { presence }]) => presence === "yes");
    const kept = certain.length ? certain : [...found];
    const answers = kept.map(([, answer]) => answer);
    const most = (rows: Float32Array[]): Float32Array => rows[0].map((_, i) => Math.max(...rows.map((row) => row[i])));
    const scores = most(answers.map((answer) => answer.scores));
    return { scores, own: most(answers.map((answer) => answer.own ?? answer.scores)), note: `the ${part} of the ${kept.map(([name]) => name).join(" and the ")}`, ...(certain.length ? {} : { presence: "unsure" as const }) };
  }

  /** "Unsure" and a note for a part that another name of a part fits better. */
  #doubt(phrase: string, splats: number[], { fits, rule }: Description): Partial<Answer> {
    const place = this.language.distribution(splats, splats.map((i) => this.segments!.masses[i]));
    return splats.length && isDoubtful(phrase, place, fits!, rule) ? { presence: "unsure", note: rule.doubtful } : {};
  }

  /** Scores of a part, cut within its thing; null for what is none, or whose thing is not here. */
  async #cut(
    phrase: string, own: Float32Array, whole: Float32Array, segments: Segments, cuts: NonNullable<Tables["cuts"]>,
  ): Promise<Float32Array | null> {
    const name = thingOfPart(phrase, cuts.words);
    const thing = name ? await this.#plain(name, name, "") : null;
    if (!thing || thing.presence === "no") return null;
    const splats = this.#seen(thing.scores, thing.threshold, segments);
    if (splats.length < cuts.fewest) return null;
    const taken = this.#seen(whole, thing.threshold, segments);
    return partScores(own, withParts(splats, taken, this.geometry, segments.labels), this.geometry, segments.masses, cuts);
  }

  /** The splats that reach a threshold and that a photo shows. */
  #seen(scores: Float32Array, threshold: number, { hidden }: Segments): number[] {
    return Array.from(scores.keys()).filter((i) => scores[i] >= threshold && !hidden[i]);
  }

  async refine(answer: Answer): Promise<void> {
    answer.places ??= answer.members;
    if (answer.places) return;
    if (answer.parts && answer.threshold === answer.automatic) {
      for (const part of answer.parts) await this.refine(part);
      answer.places = painted(answer) ? apart(answer.parts.flatMap((part) => part.places ?? [])) : [];
      return;
    }
    const hidden = this.segments?.hidden;
    const seen = (place: Place): Place => (hidden ? { ...place, splats: place.splats.filter((i) => !hidden[i]) } : place);
    const compared = answer.threshold === answer.automatic ? (answer.own ?? answer.scores) : null;
    const found = painted(answer) ? this.geometry.places(answer.scores, answer.threshold, compared) : [];
    answer.places = found.map(seen).filter(({ splats }) => splats.length > 0);
  }

  async whatIs(x: number, y: number): Promise<Clicked | null> {
    const hit = this.geometry.hit(this.stage.ray(x, y));
    if (!hit) return null;
    const names = this.dictionary.name(this.language.distribution(hit.splats, hit.shares), 4);
    return { names, point: hit.point.toArray(), found: null };
  }
}

/** An answer to words that were not understood, or not known: nothing about it is certain. */
function doubtful<T extends Answer | null>(answer: T, note: string): T {
  if (!answer) return answer;
  const presence = answer.presence === "yes" ? "unsure" : answer.presence;
  return { ...answer, note: [answer.note, note].filter(Boolean).join("; "), unknown: true, presence };
}

/** The answer to words without grammar: "unsure" in any case, and nothing where they are not here either. */
function unread(answer: Answer | null, note: string): Answer | null {
  const told = doubtful(answer, note);
  if (told?.presence !== "no") return told;
  const scores = told.scores.map((score) => Math.min(score, told.threshold - 1e-4)); // nothing is painted
  return { ...told, presence: "unsure", scores, own: null, places: [], members: null };
}

/** Places without those that are mostly in an earlier one. */
function apart(places: Place[]): Place[] {
  const taken = new Set<number>();
  return places.filter(({ splats }) => {
    const shared = splats.filter((splat) => taken.has(splat)).length;
    for (const splat of splats) taken.add(splat);
    return shared <= splats.length / 2;
  });
}
