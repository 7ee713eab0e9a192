// Phrases with their tables of relevancies, found by spelling: exact, by prefix, and with typing errors.

import type { Grammar } from "./grammar";
import { type Language, type Table, dot } from "./language";
import type { Presence } from "./rules";

/** Lower case, single spaces, no mark at the end. */
export function plainly(text: string): string {
  return text.normalize("NFC").toLowerCase().replace(/\s+/g, " ").replace(/[?!.]+\s*$/, "").trim();
}

/** A phrase as it is, and what it may be in the singular. */
export function singulars(phrase: string): string[] {
  return [phrase, phrase.replace(/ies$/, "y"), phrase.replace(/e?s$/, ""), phrase.replace(/s$/, "")];
}

export class Dictionary {
  readonly phrases: string[];
  /** What each phrase is: asked of this scene before (a), a name (n), a name with a color or part (c), a use (u). */
  #kinds: string;
  #presences: string;
  readonly #places = new Map<string, number>();
  readonly #words = new Map<string, number>();
  readonly #tables: Uint8Array;
  readonly #numCodes: number;
  /** The best relevancy of each phrase among the codes of the scene, and its mean over the scene. */
  #strengths = new Float32Array(0);
  #means = new Float32Array(0);

  /**
   * `list` has a phrase a line, its kind and presence in front; `tables` a relevancy for each phrase and code in
   * 255ths, empty where a server answers.
   */
  constructor(list: string, tables: Uint8Array, numCodes: number, readonly grammar: Grammar) {
    const lines = list.split("\n").filter(Boolean);
    this.#kinds = lines.map((line) => line[0]).join("");
    this.#presences = lines.map((line) => line[1]).join("");
    this.phrases = lines.map((line) => line.slice(2));
    this.#tables = tables;
    this.#numCodes = numCodes;
    this.phrases.forEach((phrase, place) => {
      this.#places.set(phrase.toLowerCase(), place);
      for (const word of phrase.toLowerCase().split(" ")) this.#words.set(word, (this.#words.get(word) ?? 0) + 1);
    });
  }

  /** Finds which phrases this scene can answer: the best relevancy among the codes that it uses. */
  rank(language: Language, shown: Uint32Array): void {
    const shares = language.distribution(shown);
    const used = [...shares.keys()].filter((code) => shares[code] > 5e-4);
    this.#strengths = Float32Array.from(this.phrases, (_, place) => {
      let best = 0;
      for (const code of used) best = Math.max(best, this.#tables[place * this.#numCodes + code]);
      return best / 255;
    });
    this.#means = Float32Array.from(this.phrases, (_, place) => dot(this.#row(place), shares) / 255);
  }

  /** Offer a phrase first from now on. */
  remember(phrase: string): void {
    if (this.phrases[0]?.toLowerCase() === phrase.toLowerCase()) return;
    this.phrases.unshift(phrase);
    this.#kinds = `a${this.#kinds}`;
    this.#presences = `y${this.#presences}`;
  }

  #row(place: number): Uint8Array {
    return this.#tables.subarray(place * this.#numCodes, (place + 1) * this.#numCodes);
  }

  /** Whether a phrase is here as it is typed. */
  has(text: string): boolean {
    return this.#places.has(text.trim().toLowerCase());
  }

  /** The place of a phrase as it is, or in the singular; -1 if it is unknown. */
  find(text: string): number {
    for (const form of [text.trim().toLowerCase(), ...singulars(plainly(text))]) {
      const place = this.#places.get(form);
      if (place !== undefined) return place;
    }
    return -1;
  }

  /** The table of a phrase. */
  table(place: number): Table {
    return Float32Array.from(this.#row(place), (value) => value / 255);
  }

  /** Whether the scene holds a phrase, as found when the page was published. */
  presence(place: number): Presence {
    return ({ y: "yes", u: "unsure" } as const)[this.#presences[place]] ?? "no";
  }

  /** Phrases that begin with what was typed, or have a word that does; then with typing errors. */
  complete(text: string, count = 8): string[] {
    const typed = this.#phrase(text);
    if (!typed) return this.examples(count);
    const scored: [number, number][] = [];
    this.phrases.forEach((phrase, place) => {
      const lower = phrase.toLowerCase();
      const begins = lower.startsWith(typed);
      if (!begins && !lower.includes(` ${typed}`)) return;
      const asked = this.#kinds[place] === "a" ? 0.3 : 0;
      const here = { y: 0.5, u: 0.2 }[this.#presences[place]] ?? 0;
      scored.push([place, (begins ? 1 : 0) + asked + here + (this.#strengths[place] ?? 0) * 0.3 - lower.length / 200]);
    });
    const found = scored.sort((a, b) => b[1] - a[1]).slice(0, count).map(([place]) => this.phrases[place]);
    return found.length ? found : this.similar(text, count);
  }

  /** Phrases to begin with: names of small things of this scene, each answered best by another code. */
  examples(count: number): string[] {
    const merit = (place: number): number => this.#strengths[place] - 3 * this.#means[place];
    const order = [...this.phrases.keys()]
      .filter((place) => "na".includes(this.#kinds[place]) && this.#presences[place] === "y")
      .sort((a, b) => merit(b) - merit(a));
    const seen = new Set<number>();
    const chosen: string[] = [];
    for (const place of order) {
      const row = this.#row(place);
      const best = row.indexOf(Math.max(...row));
      if (seen.has(best) || chosen.some((other) => shareWord(other, this.phrases[place]))) continue;
      seen.add(best);
      chosen.push(this.phrases[place]);
      if (chosen.length === count) break;
    }
    return chosen;
  }

  /** What is typed, without a question around it. */
  #phrase(text: string): string {
    const plain = plainly(text);
    return plain && this.grammar.undetermined(this.grammar.phrase(this.grammar.inFull(plain)));
  }

  /** The phrases with the most similar spelling, the nearest first. */
  similar(text: string, count = 3): string[] {
    const names = (word: string): boolean => !this.grammar.has("closed", word) && !["the", "of", "a", "an"].includes(word);
    const typed = this.#phrase(text).split(" ").filter((word) => names(word) && (word.length > 2 || this.#words.has(word)));
    const corrected = typed.map((word) => (this.#words.has(word) ? word : this.#nearestWord(word)));
    if (!corrected.some(Boolean)) return [];
    const scored: [number, number][] = [];
    this.phrases.forEach((phrase, place) => {
      const words = phrase.toLowerCase().split(" ");
      const shared = corrected.filter((word) => word && words.includes(word)).length;
      if (shared === 0) return;
      // The last word of an English phrase names the thing.
      const thing = words.at(-1) === corrected.at(-1) ? 0.5 : 0;
      scored.push([place, shared + thing - 0.2 * Math.abs(words.length - typed.length) + 0.1 * (this.#strengths[place] ?? 0)]);
    });
    return scored.sort((a, b) => b[1] - a[1]).slice(0, count).map(([place]) => this.phrases[place]);
  }

  /** What a distribution over codes is most likely called. */
  name(distribution: Float32Array, count: number): { phrase: string; score: number }[] {
    const scored: { phrase: string; score: number }[] = [];
    this.phrases.forEach((phrase, place) => {
      if (!"na".includes(this.#kinds[place]) || this.#presences[place] === "n") return;
      scored.push({ phrase, score: dot(this.#row(place), distribution) / 255 });
    });
    return scored.sort((a, b) => b.score - a.score).slice(0, count);
  }

  #nearestWord(word: string): string {
    const most = word.length > 6 ? 2 : 1;
    let best = "";
    let least = Infinity;
    for (const [known, uses] of this.#words) {
      if (Math.abs(known.length - word.length) > most || known.length < 3) continue;
      const errors = typingErrors(word, known, most + 1);
      if (errors > most) continue;
      const cost = errors - Math.min(0.5, uses / 1000); // of two, the word of more phrases
      if (cost < least) [best, least] = [known, cost];
    }
    return best;
  }
}

function shareWord(a: string, b: string): boolean {
  const words = new Set(a.split(" "));
  return b.split(" ").some((word) => words.has(word));
}

/** Letters to add, drop, replace or swap between two words, or `limit` if there are at least that many. */
export function typingErrors(a: string, b: string, limit: number): number {
  let before: number[] = [];
  let row = Array.from({ length: b.length + 1 }, (_, j) => j);
  for (let i = 1; i <= a.length; i++) {
    const next = [i];
    for (let j = 1; j <= b.length; j++) {
      const replace = row[j - 1] + Number(a[i - 1] !== b[j - 1]);
      next[j] = Math.min(replace, row[j] + 1, next[j - 1] + 1);
      if (i > 1 && j > 1 && a[i - 1] === b[j - 2] && a[i - 2] === b[j - 1]) next[j] = Math.min(next[j], before[j - 2] + 1);
    }
    if (Math.min(...next) >= limit) return limit;
    [before, row] = [row, next];
  }
  return row[b.length];
}
