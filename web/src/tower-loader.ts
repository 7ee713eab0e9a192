// Loads the text tower when it is first needed; a large one only after the visitor agreed to its size.

import type { Files, Manifest } from "./manifest";
import { TextTower } from "./tower";

/** Towers of at most this size are loaded without asking. */
const SMALL_BYTES = 8e6;

export class TowerLoader {
  readonly bytes: number;
  #agreed: boolean;
  #tower: Promise<TextTower> | null = null;

  constructor(readonly files: Files, readonly manifest: Manifest) {
    this.bytes = manifest.files[manifest.text!.weights].bytes;
    this.#agreed = this.bytes <= SMALL_BYTES || files.inside;
  }

  /** Whether the visitor has to agree first. */
  get waiting(): boolean {
    return !this.#agreed;
  }

  async agree(): Promise<void> {
    this.#agreed = true;
    await this.load();
  }

  /** The tower; null while the visitor has not agreed. */
  async load(): Promise<TextTower | null> {
    if (!this.#agreed) return null;
    const { weights, tokenizer } = this.manifest.text!;
    this.#tower ??= Promise.all([this.files.read(weights), this.files.read(tokenizer)]).then(
      ([tensors, words]) => new TextTower(tensors, words, this.manifest),
    );
    return this.#tower;
  }
}
