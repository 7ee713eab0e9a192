// The automatic threshold and "not here", as lexsplat.queries.thresholds and lexsplat.queries.presence decide them.
// tests/scenes/test_publishing.py compares them with Python's.

import type { PresenceRule } from "./manifest";
import { type Language, type Samples, type Table, dot } from "./language";

export type Presence = "yes" | "no" | "unsure";

/** Relevancy at which a prompt and a canonical phrase are equally near. */
const BORDER = 0.5;
const TOP_SHARE = 5e-4;
const BINS = 512;
const TEMPERING = 0.5;
const MIN_CONTRAST = 0.05;
const PEAK_COUNT = 20;

/** The threshold of a prompt; 0.5 for what the scene does not hold. */
export function automaticThreshold(table: Table, samples: Samples, presence: Presence): number {
  if (presence === "no") return BORDER;
  let row = samples.scores(table);
  const reached = topMean(row) > BORDER;
  for (;;) {
    const found = bestCut(row);
    if (!found) return BORDER;
    const { cut, lower, upper } = found;
    if (!(reached && upper < BORDER)) return lower < BORDER && BORDER < upper ? BORDER : cut;
    row = row.filter((value) => value >= cut);
  }
}

function topMean(row: Float64Array): number {
  const sorted = row.slice().sort().reverse();
  const limit = sorted.length * TOP_SHARE;
  let sum = 0;
  for (let i = 0; i < sorted.length && i < limit; i++) sum += sorted[i] * Math.min(1, limit - i);
  return sum / limit;
}

/** Otsu's cut on a histogram of square-rooted counts, and the means on either side; null without contrast. */
function bestCut(row: Float64Array): { cut: number; lower: number; upper: number } | null {
  let low = Infinity;
  let high = -Infinity;
  for (const value of row) {
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  if (!(high - low >= MIN_CONTRAST)) return null;
  const width = (high - low) / BINS;
  const counts = new Float64Array(BINS);
  for (const value of row) counts[Math.min(BINS - 1, Math.floor((value - low) / width))]++;
  const quantile = (q: number): number => {
    let sum = 0;
    for (let i = 0; i < BINS; i++) if ((sum += counts[i] / row.length) >= q) return i;
    return BINS - 1;
  };
  if ((quantile(0.998) - quantile(0.5)) * width < MIN_CONTRAST) return null;
  const heights = counts.map((count) => count ** TEMPERING * Number(count > 0));
  const center = (i: number): number => low + width * (i + 0.5);
  let total = 0;
  let moment = 0;
  heights.forEach((height, i) => {
    total += height;
    moment += height * center(i);
  });
  const between = new Float64Array(BINS - 1);
  const means: { lower: number; upper: number }[] = [];
  for (let i = 0, below = 0, first = 0; i < BINS - 1; i++) {
    below += heights[i];
    first += heights[i] * center(i);
    const lower = first / below;
    const upper = (moment - first) / (total - below);
    means.push({ lower, upper });
    between[i] = below * (total - below) * (lower - upper) ** 2;
  }
  const limit = between.reduce((a, b) => Math.max(a, b), 0) * (1 - 1e-12);
  const best: number[] = []; // all cuts inside a gap score the same: the middle of them
  between.forEach((value, i) => value >= limit && best.push(i));
  const cut = low + width * (best.reduce((a, b) => a + b, 0) / best.length + 1);
  return { cut, ...means[best[0]] };
}

/** Decides whether the scene holds what a table of relevancies stands for. */
export class PresenceClassifier {
  readonly #references: Table[];

  constructor(
    readonly rule: PresenceRule,
    readonly language: Language,
    readonly shown: Uint32Array,
    tableOf: (phrase: string) => Table,
  ) {
    this.#references = rule.references.map(tableOf);
  }

  classify(scores: Float32Array): Presence {
    if (this.shown.length === 0) return "no";
    const count = Math.min(this.shown.length, Math.max(PEAK_COUNT, Math.floor(TOP_SHARE * this.shown.length)));
    const best = largest(scores, this.shown, count);
    const peak = best.reduce((sum, splat) => sum + scores[splat], 0) / best.length;
    const there = this.language.distribution(best);
    const lower = this.#references.filter((table) => dot(table, there) < peak).length;
    const { weights, yes, no, middle, spread } = this.rule;
    const height = Math.min(10, Math.max(-5, (peak - middle) / Math.max(spread, 1e-4)));
    const bounded = Math.min(1 - 1e-3, Math.max(1e-3, peak));
    const logit =
      weights.bias +
      weights.height * height +
      (weights.rank * lower) / this.#references.length +
      weights.peak * Math.log(bounded / (1 - bounded));
    const probability = 1 / (1 + Math.exp(-logit));
    return probability >= yes ? "yes" : probability <= no ? "no" : "unsure";
  }
}

/** The `count` indices among `of` with the largest values, without sorting them all. */
export function largest(values: Float32Array, of: ArrayLike<number> & Iterable<number>, count: number): number[] {
  const counts = new Uint32Array(4096);
  const bin = (value: number): number => Math.min(4095, Math.max(0, Math.floor(value * 4096)));
  for (const i of of) counts[bin(values[i])]++;
  let border = 4095;
  for (let sum = counts[border]; sum < count && border > 0; sum += counts[--border]);
  const candidates: number[] = [];
  for (const i of of) if (bin(values[i]) >= border) candidates.push(i);
  return candidates.sort((a, b) => values[b] - values[a]).slice(0, count);
}
