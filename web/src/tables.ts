// Answers without a server: the dictionary, then the text tower, then whole segments.

import { type Answer, type Clicked, type Source, answered, painted } from "./answers";
import { Dictionary, normalize, singulars } from "./dictionary";
import type { Geometry, Place } from "./geometry";
import { type Language, shownSplats } from "./language";
import { type Presence, hasColor, isPart, peakOf, presenceOf, strengthsOf, thingOfPart } from "./rules";
import type { Kinds } from "./kinds";
import type { Segments } from "./segments";
import type { Spelling } from "./spelling";
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
    readonly dictionary: Dictionary,
    readonly loader: TowerLoader | null,
    readonly kinds: Kinds,
    /** Null in pages that were published without English words. */
    readonly spelling: Spelling | null,
    /** Whether the encoder knows English words alone. */
    readonly englishOnly: boolean,
  ) {
    this.#shown = shownSplats(geometry.opacities, geometry.rule.evidence_faint);
    dictionary.rank(language, this.#shown);
    this.examples = dictionary.examples(4);
  }

  complete(text: string): string[] {
    return this.dictionary.complete(text);
  }

  async answer(prompt: string, color: string): Promise<Answer | null> {
    if (!this.spelling || this.dictionary.find(prompt) >= 0) return this.#asked(prompt, prompt, color);
    const phrase = normalize(prompt);
    for (const { phrase: meant, note } of this.spelling.meant(phrase)) {
      const answer = await this.#asked(meant, prompt, color);
      if (answer && answer.presence !== "no") return { ...answer, note };
    }
    const answer = await this.#asked(prompt, prompt, color);
    const strange = this.englishOnly ? this.spelling.strange(phrase) : [];
    if (!answer || strange.length === 0) return answer;
    const listed = strange.slice(0, 3).map((word) => `“${word.slice(0, 40)}”`).join(", ");
    const note = `the bundled encoder knows English words alone, not ${listed}`;
    return { ...answer, note, unknown: true, presence: answer.presence === "yes" ? "unsure" : answer.presence };
  }

  /** The answer to a text, for what was typed. */
  async #asked(text: string, prompt: string, color: string): Promise<Answer | null> {
    const plain = await this.#plain(text, prompt, color);
    const kind = singulars(normalize(text)).find((form) => this.kinds.has(form));
    return kind && plain ? this.kinds.answer(kind, plain) : plain;
  }

  /** The answer to a phrase by its own relevancy. */
  async #plain(text: string, prompt: string, color: string): Promise<Answer | null> {
    const known = this.dictionary.find(text);
    if (known >= 0) {
      const own = this.language.scores(this.dictionary.table(known));
      const presence = this.dictionary.presence(known);
      const phrase = this.dictionary.phrases[known];
      return answered(prompt, color, { phrase, from: "dictionary", ...this.#whole(own, presence) });
    }
    const phrase = normalize(text);
    const tower = await this.loader?.load();
    if (!tower) return null;
    const described = tower.describe(phrase);
    const own = this.language.scores(described.table);
    const thing = thingOfPart(phrase, described.rule);
    const presence = this.#presence(phrase, own, described, thing ? tower.describe(thing) : null);
    return answered(prompt, color, { phrase, from: "text tower", ...this.#whole(own, presence) });
  }

  /** As `lexsplat.queries.presence` has it: parts at segments, all else at objects. */
  #presence(phrase: string, own: Float32Array, described: Description, thing: Description | null): Presence {
    const { heights, best, rule, places, colored } = described;
    if (this.#shown.length === 0) return "no";
    if (!this.segments || !places || !colored) {
      const peak = peakOf(own, this.language, this.#shown, this.geometry.rule);
      return presenceOf(strengthsOf(heights, peak, best, rule), rule, rule.yes);
    }
    if (isPart(phrase, rule)) {
      this.#parts ??= this.segments.distributions(this.language);
      const strengths = strengthsOf(heights, this.#parts, best, rule);
      if (!thing) return presenceOf(strengths, rule, rule.yes_segment);
      const held = strengthsOf(thing.heights, places, thing.compared, rule).some((value) => value >= rule.no);
      const there = strengthsOf(thing.heights, this.#parts, thing.compared, rule);
      return presenceOf(held ? strengths.filter((_, place) => there[place] >= rule.at_thing) : [], rule, rule.yes_part);
    }
    return hasColor(phrase, rule)
      ? presenceOf(strengthsOf(heights, places, colored, rule), rule, rule.yes_colored)
      : presenceOf(strengthsOf(heights, places, best, rule), rule, rule.yes_segment);
  }
  #parts: Float32Array | null = null;

  /** By segments, something would always be taken: what is not here keeps the scores of single splats. */
  #whole(own: Float32Array, presence: Presence) {
    const scores = this.segments && presence !== "no" ? this.segments.scores(own) : own;
    return { scores, presence, threshold: this.geometry.rule.threshold };
  }

  async refine(answer: Answer): Promise<void> {
    answer.places ??= answer.members;
    if (answer.places) return;
    const hidden = this.segments?.hidden;
    const seen = (place: Place): Place => (hidden ? { ...place, splats: place.splats.filter((i) => !hidden[i]) } : place);
    const found = painted(answer) ? this.geometry.places(answer.scores, answer.threshold) : [];
    answer.places = found.map(seen).filter(({ splats }) => splats.length > 0);
  }

  async whatIs(x: number, y: number): Promise<Clicked | null> {
    const hit = this.geometry.hit(this.stage.ray(x, y));
    if (!hit) return null;
    const names = this.dictionary.name(this.language.distribution(hit.splats, hit.shares), 4);
    return { names, point: hit.point.toArray(), found: null };
  }
}
