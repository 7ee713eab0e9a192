// CLIP's tokenizer: byte-level byte-pair encoding of lower-case words that end in "</w>".

export interface TokenizerFile {
  vocabulary: Record<string, number>;
  merges: string[];
  start: number;
  end: number;
}

const WORDS = /<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|\p{L}+|\p{N}|[^\s\p{L}\p{N}]+/gu;

/** A printable character for each byte, as GPT-2 has it. */
const CHARACTERS = (() => {
  const printable = (byte: number): boolean =>
    (byte >= 33 && byte <= 126) || (byte >= 161 && byte <= 172) || (byte >= 174 && byte <= 255);
  let next = 256;
  return Array.from({ length: 256 }, (_, byte) => String.fromCodePoint(printable(byte) ? byte : next++));
})();

export class Tokenizer {
  readonly #file: TokenizerFile;
  readonly #ranks: Map<string, number>;
  readonly #length: number;

  /** `length` is the largest number of tokens, with those of start and end. */
  constructor(file: TokenizerFile, length: number) {
    this.#file = file;
    this.#ranks = new Map(file.merges.map((pair, rank) => [pair, rank]));
    this.#length = length;
  }

  /** Tokens between those of start and end; long texts are truncated. */
  encode(text: string): number[] {
    const { vocabulary, start, end } = this.#file;
    const plain = text.normalize("NFC").replace(/\s+/g, " ").toLowerCase();
    const tokens: number[] = [];
    for (const [word] of plain.matchAll(WORDS)) {
      for (const piece of this.#pieces(word)) tokens.push(vocabulary[piece] ?? end);
    }
    return [start, ...tokens.slice(0, this.#length - 2), end];
  }

  #pieces(word: string): string[] {
    const bytes = new TextEncoder().encode(word);
    let parts = Array.from(bytes, (byte) => CHARACTERS[byte]);
    parts[parts.length - 1] += "</w>";
    while (parts.length > 1) {
      let best = -1;
      let rank = Infinity;
      for (let i = 0; i + 1 < parts.length; i++) {
        const found = this.#ranks.get(`${parts[i]} ${parts[i + 1]}`);
        if (found !== undefined && found < rank) [best, rank] = [i, found];
      }
      if (best < 0) break;
      const pair = parts[best] + parts[best + 1];
      const [left, right] = [parts[best], parts[best + 1]];
      const merged: string[] = [];
      for (let i = 0; i < parts.length; i++) {
        if (parts[i] === left && parts[i + 1] === right) {
          merged.push(pair);
          i++;
        } else merged.push(parts[i]);
      }
      parts = merged;
    }
    return parts;
  }
}
