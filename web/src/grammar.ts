// The words and patterns of lexsplat.queries.grammar, which the manifest carries: questions without what is around
// the thing, and what is left in a thing although it names none.

import type { GrammarEntry } from "./manifest";

/** A part in quotation marks, by its number. */
export const HIDDEN = /\0(\d+)\0/g;

export class Grammar {
  readonly #patterns = new Map<string, RegExp>();
  readonly #replaced: Record<keyof GrammarEntry["replaced"], [RegExp, string][]>;
  readonly #words: Record<string, Set<string>>;

  constructor(readonly entry: GrammarEntry) {
    for (const [name, source] of Object.entries(entry.patterns)) this.#patterns.set(name, new RegExp(source, "i"));
    const compiled = (pairs: [string, string][], flags: string) =>
      pairs.map(([source, instead]): [RegExp, string] => [new RegExp(source, flags), instead.replace(/\\(\d)/g, "$$$1")]);
    const { contractions, reworded, frames } = entry.replaced;
    this.#replaced = { contractions: compiled(contractions, "gi"), reworded: compiled(reworded, "gi"), frames: compiled(frames, "i") };
    this.#words = Object.fromEntries(Object.entries(entry.words).map(([name, words]) => [name, new Set(words)]));
  }

  /** Where a pattern is in a text. */
  find(name: string, text: string): RegExpExecArray | null {
    return this.#patterns.get(name)!.exec(text);
  }

  /** A pattern at the beginning of a text. */
  match(name: string, text: string): RegExpExecArray | null {
    const found = this.find(name, text);
    return found?.index === 0 ? found : null;
  }

  list(kind: string): string[] {
    return [...this.#words[kind]];
  }

  has(kind: string, word: string): boolean {
    return this.#words[kind].has(word.toLowerCase());
  }

  /** A text without its first place of a pattern. */
  without(name: string, text: string): string {
    return text.replace(this.#patterns.get(name)!, "");
  }

  /** "What is" for "what's", and a question without its "not". */
  inFull(text: string): string {
    const { contractions, reworded } = this.#replaced;
    return [...contractions, ...reworded].reduce((words, [pattern, instead]) => words.replace(pattern, instead), text);
  }

  /** A question or request without the words around the thing: "where can I find the mug" is "the mug". */
  phrase(whole: string): string {
    let words = whole;
    let before = "";
    let asked = false;
    while (words !== before) {
      before = words;
      words = this.#withoutTail(this.without("tag", this.without("where_is_it", words)));
      const frame = this.#framed(words);
      if (frame !== null) words = frame;
      else if (this.match("is", words)) {
        words = this.without("is", words);
        asked = true;
      }
    }
    words = words.replace(this.#patterns.get("purpose")!, "something to $2");
    if (asked) words = this.#qualityFirst(words) || `is ${words}`;
    return words || whole;
  }

  /** The words without the first frame that they are in; null if they are in none. */
  #framed(words: string): string | null {
    for (const [pattern, instead] of this.#replaced.frames) {
      const found = pattern.exec(words);
      if (!found) continue;
      const used = instead === "something to @ in" ? `something to ${found.slice(1).filter(Boolean).join(" ")} in` : instead;
      const rest = used.replace(/\$(\d)/g, (_, group: string) => found[Number(group)] ?? "") + words.slice(found[0].length);
      return /^(?:how (?:many|much)|count|.*\b(?:number|amount|quantity) of)/i.test(found[0]) ? this.without("counted_tail", rest) : rest;
    }
    return null;
  }

  #withoutTail(words: string): string {
    const shorter = this.without("tail", words);
    return shorter.split(" ").length > 1 || !["is", "are", "there"].includes(shorter.toLowerCase()) ? shorter : words;
  }

  /** The statement "the mug red" as a phrase: "red mug"; a statement with a place stays as it is. */
  #qualityFirst(words: string): string {
    const found = this.match("last_qualities", words);
    if (!found) return words;
    const noun = found[1].replace(/ not$/i, "");
    if (noun !== found[1]) return `${this.without("articles", noun)} that is not ${found[2]}`;
    return /\b(?:and|or)\b/i.test(found[1]) ? "" : `${found[2]} ${this.without("articles", found[1])}`;
  }

  /** What is left in a text that should name a thing; "" if nothing. */
  leftOver(text: string): string {
    const question = this.find("left_over", text);
    if (question) return question[0];
    if (text.toLowerCase() === "can") return "";
    const described = this.match("describes", text);
    const verbs = described ? described[0].length : text.length;
    const shown = text.replace(new RegExp(this.#patterns.get("fixed")!, "gi"), (words) => ".".repeat(words.length));
    const places = ["part_of", "unit", "numeral", "does", "starts", ...(described ? [] : ["later", "article"])]
      .map((name) => this.find(name, shown))
      .filter((found) => found !== null)
      .map((found): [number, number] => [found.index, found.index + found[0].length]);
    for (const found of shown.matchAll(/[\p{L}\p{N}]+(?:['\u2019-][\p{L}\p{N}]+)*/gu)) {
      const word = found[0].toLowerCase();
      const end = found.index + word.length;
      const allowed =
        (described && end <= verbs && ["that", "which", "who"].includes(word)) || (found.index >= verbs && this.has("verb_phrase", word));
      if (!this.has("closed", word) || allowed) continue;
      places.push([found.index, end]);
      break;
    }
    if (places.length === 0) return this.#size(text);
    const [start, end] = places.reduce((a, b) => (a[0] < b[0] || (a[0] === b[0] && a[1] <= b[1]) ? a : b));
    return text.slice(start, end).trim();
  }

  /** A size that is asked of no certain thing: "big toys", "something small red". */
  #size(text: string): string {
    const words = text.toLowerCase().split(" ");
    const many = words.length > 1 && (words[0] === "something" || this.has("kinds", words.at(-1)!));
    return words.slice(0, -1).find((word) => this.has(many ? "sizes" : "relative", word)) ?? "";
  }

  /** Words without articles and the like in front. */
  undetermined(words: string): string {
    let shorter = words;
    do {
      words = shorter;
      shorter = this.without("determiner", words);
    } while (shorter !== words);
    return words;
  }

  /** What a numeral says; "several" and the like are two. */
  number(word: string): number {
    return /^\d/.test(word) ? parseInt(word) : this.entry.words.numbers.indexOf(word.toLowerCase()) + 1 || 2;
  }
}
