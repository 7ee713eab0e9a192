// The language of the splats: codes and their weights, and what a table of relevancies makes of them.

/** Codes stored for each splat. */
const TOP = 4;
/** Largest weight of the second, third and fourth code: weights are sorted and sum to at most 1. */
const LARGEST = [1, 1 / 2, 1 / 3, 1 / 4];

/**
 * A relevancy for every code, 0..1. The score of a splat is the sum of weight times relevancy over its codes
 * (the "code" form of lexsplat.queries.relevancy).
 */
export type Table = Float32Array;

export class Language {
  readonly codes: Uint8Array;
  readonly shares: Uint8Array;
  readonly count: number;
  readonly numCodes: number;

  /** `content` is codes [N, 4] followed by shares [N, 4]; see `weights`. */
  constructor(content: Uint8Array, numCodes: number) {
    this.count = content.length / (2 * TOP);
    this.numCodes = numCodes;
    this.codes = content.subarray(0, this.count * TOP);
    this.shares = content.subarray(this.count * TOP);
  }

  /**
   * The weights of a splat's codes. The first share is the sum of all weights in 255ths; the others are the weights of
   * the second to fourth code in 255ths of the largest value each can have. The first weight is what remains.
   */
  weights(splat: number, out: Float32Array): void {
    const s = this.shares;
    const i = splat * TOP;
    out[1] = (s[i + 1] / 255) * LARGEST[1];
    out[2] = (s[i + 2] / 255) * LARGEST[2];
    out[3] = (s[i + 3] / 255) * LARGEST[3];
    out[0] = Math.max(0, s[i] / 255 - out[1] - out[2] - out[3]);
  }

  /** Scores [N] of all splats for a table. */
  scores(table: Table): Float32Array {
    const scores = new Float32Array(this.count);
    const { codes, shares } = this;
    const total = 1 / 255;
    const [, second, third, fourth] = LARGEST.map((largest) => largest / 255);
    for (let splat = 0, i = 0; splat < scores.length; splat++, i += TOP) {
      const b = shares[i + 1] * second;
      const c = shares[i + 2] * third;
      const d = shares[i + 3] * fourth;
      const a = Math.max(0, shares[i] * total - b - c - d);
      scores[splat] =
        a * table[codes[i]] + b * table[codes[i + 1]] + c * table[codes[i + 2]] + d * table[codes[i + 3]];
    }
    return scores;
  }

  /** The mean distribution over codes [K] of some splats, each with a weight. */
  distribution(splats: ArrayLike<number>, weights?: ArrayLike<number>): Float32Array {
    const mean = new Float32Array(this.numCodes);
    const own = new Float32Array(TOP);
    let sum = 0;
    for (let n = 0; n < splats.length; n++) {
      const share = weights ? weights[n] : 1;
      this.weights(splats[n], own);
      for (let t = 0; t < TOP; t++) mean[this.codes[splats[n] * TOP + t]] += share * own[t];
      sum += share;
    }
    for (let k = 0; k < mean.length; k++) mean[k] /= sum || 1;
    return mean;
  }
}

/** The indices of splats that are at least as opaque as `faint`. */
export function shownSplats(opacities: Float32Array, faint: number): Uint32Array {
  const shown = new Uint32Array(opacities.length);
  let count = 0;
  for (let i = 0; i < opacities.length; i++) if (opacities[i] >= faint) shown[count++] = i;
  return shown.subarray(0, count);
}

export function dot(a: ArrayLike<number>, b: ArrayLike<number>): number {
  let sum = 0;
  for (let i = 0; i < a.length; i++) sum += a[i] * b[i];
  return sum;
}
