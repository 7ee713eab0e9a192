// Typing errors, mended as lexsplat.queries.spelling does: similar words of things for words that are not English.

import { singulars } from "./dictionary";

const SAME_FORM = new Set(["stairs", "scissors", "trousers", "clothes", "pants"]);
const HASHES = 5;
/** Letters of a part of a compound word, at least. */
const SHORTEST = 3;
/** What a phrase with several typing errors may mean, at most. */
const MOST = 4;

export class Spelling {
  readonly #bits: Uint8Array;
  /** The words of things: what a typing error may mean. */
  readonly #known: Set<string>;

  /** `bits` is the filter of lexsplat.scenes.publishing.english; `things` are names, qualities and kinds. */
  constructor(bits: Uint8Array, things: string[]) {
    this.#bits = bits;
    this.#known = new Set(things.flatMap((thing) => thing.toLowerCase().split(" ")));
  }

  /** Whether a text is an English word; 2 % of other texts count as words too. */
  isWord(word: string): boolean {
    const step = (hash: number, letter: number): number => Math.imul(hash ^ letter, 16777619) >>> 0;
    let first = 2166136261;
    for (const letter of word) first = step(first, letter.charCodeAt(0));
    const second = (step(first, 0) | 1) >>> 0;
    const size = 8 * this.#bits.length;
    return Array.from({ length: HASHES }, (_, n) => (first + n * second) % size).every((bit) => (this.#bits[bit >> 3] >> (bit & 7)) & 1);
  }

  /** What a phrase may mean, the likeliest first: each with its words in place of the typed ones; empty if it is well spelled. */
  meant(phrase: string): { phrase: string; note: string }[] {
    const typed = phrase.split(" ");
    const choices = typed.map((word) => this.#meant(word));
    let found: string[][] = [[]];
    for (const words of choices) found = found.flatMap((before) => words.map((word) => [...before, word])).slice(0, MOST * MOST);
    return found.slice(0, MOST).map((words) => ({
      phrase: words.join(" "),
      note: words.flatMap((word, n) => (word === typed[n] ? [] : [`“${typed[n]}” may be a typing error: asked for “${word}”`])).join("; "),
    })).filter(({ note }) => note !== "");
  }

  /** A phrase with its last word in the singular, if that is a word, as lexsplat.queries.spelling has it. */
  singular(phrase: string): string {
    const [head, ...rest] = phrase.split(" of ");
    const last = /[a-z]{3,}$/.exec(head)?.[0] ?? "";
    if (!last.endsWith("s") || /(?:ss|us|is)$/.test(last) || SAME_FORM.has(last) || phrase.includes(" to ")) return phrase;
    const [one, two] = [last.slice(0, -1), last.slice(0, -2)];
    const [f, fe] = [last.replace(/ves$/, "f"), last.replace(/ves$/, "fe")];
    const forms = /(?:ss|x|ch|sh)es$/.test(last) ? [two, one] : [f, fe, one, last.replace(/ies$/, "y"), two];
    const found = forms.find((form) => form !== last && this.isWord(form));
    return found ? [head.slice(0, -last.length) + found, ...rest].join(" of ") : phrase;
  }

  /** The words of a phrase that are neither English nor words of things. */
  strange(phrase: string): string[] {
    const isStrange = (part: string): boolean =>
      part !== "" && !this.#known.has(part) && (!/^[a-z]+$/.test(part) || (part.length > 2 && !this.isWord(part)));
    return phrase.split(" ").filter((word) => word.split(/[-',.&/]/).some(isStrange));
  }

  #meant(word: string): string[] {
    if (!/^[a-z]{3,}$/.test(word) || singulars(word).some((form) => this.#known.has(form))) return [word];
    if (this.isWord(word)) {
      const found = [...this.#known].filter((entry) => mayBeMeant(entry, word));
      return found.length === 1 ? found : [word];
    }
    const near = this.#nearest(word);
    const found = near.length || !word.endsWith("s") || word.length < 4 ? near : this.#nearest(word.slice(0, -1));
    return found.length ? found : [word];
  }

  /** The known words at one edit from a word: the same first letter, then swapped neighbors, then the longest first. */
  #nearest(word: string): string[] {
    const key = (one: string): number => (one[0] === word[0] ? 0 : 1000) + (isSwapped(one, word) ? 0 : 500) - one.length;
    const near = [...this.#known].filter((entry) => entry.length > 2 && isOneEdit(entry, word));
    return near.sort((a, b) => key(a) - key(b) || (a < b ? -1 : 1));
  }
}

/** A text with a compound word as two known words, with the last of them, or with two words as a known one. */
export function compounds(text: string, isKnown: (word: string) => boolean): { words: string; head: string }[] {
  const typed = text.split(" ");
  return typed.flatMap((word, place) => {
    const [before, after] = [typed.slice(0, place), typed.slice(place + 1)];
    const ends = [...word].map((_, end) => end).filter((end) => end >= SHORTEST && end <= word.length - SHORTEST);
    const split = ends.map((end) => [word.slice(0, end), word.slice(end)]).filter((pair) => pair.every(isKnown));
    const found = split.map((pair) => ({ words: [...before, ...pair, ...after].join(" "), head: pair[1] }));
    const joined = after.length ? word + after[0] : "";
    return isKnown(joined) ? [...found, { words: [...before, joined, ...after.slice(1)].join(" "), head: "" }] : found;
  });
}

/** Whether an English word may be a typing error of another one: a doubled letter, swapped neighbors, the last of six letters. */
function mayBeMeant(entry: string, word: string): boolean {
  const undoubled = (text: string): string => text.replace(/(.)\1/g, "$1");
  return (entry.length > 5 && entry.slice(0, -1) === word) || isSwapped(entry, word) || undoubled(entry) === undoubled(word);
}

function isSwapped(one: string, other: string): boolean {
  if (one.length !== other.length || one === other) return false;
  const n = [...one].findIndex((letter, place) => letter !== other[place]);
  return one.slice(0, n) + one[n + 1] + one[n] + one.slice(n + 2) === other;
}

function isOneEdit(one: string, other: string): boolean {
  if (Math.abs(one.length - other.length) > 1 || one === other) return false;
  if (one.length === other.length) return isSwapped(one, other) || [...one].filter((letter, n) => letter !== other[n]).length === 1;
  const [short, long] = one.length < other.length ? [one, other] : [other, one];
  return [...long].some((_, n) => long.slice(0, n) + long.slice(n + 1) === short);
}
