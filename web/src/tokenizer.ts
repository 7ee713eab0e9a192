// From a phrase to tokens, as the tokenizer.json of an encoder has it.

import { Tokenizer } from "@huggingface/tokenizers";

export class PhraseTokenizer {
  readonly #tokenizer: Tokenizer;
  readonly #length: number;
  readonly #padding: number | null;

  /** `length` is the largest number of tokens; with `padding`, every text has as many. */
  constructor(file: object, length: number, padding: number | null) {
    this.#tokenizer = new Tokenizer(file, {});
    this.#length = length;
    this.#padding = padding;
  }

  /** Tokens with those of start and end; of long texts the end is cut off, but not its token. */
  encode(text: string): number[] {
    // SigLIP was trained on lower case.
    const { ids } = this.#tokenizer.encode(this.#padding === null ? text : text.toLowerCase());
    const tokens = ids.length > this.#length ? [...ids.slice(0, this.#length - 1), ids.at(-1)!] : [...ids];
    while (this.#padding !== null && tokens.length < this.#length) tokens.push(this.#padding);
    return tokens;
  }
}
