// Whole segments are taken or left: lexsplat.queries.segments in the browser. tests/scenes/test_published_page.py
// compares the scores.

import { DataUtils } from "three";
import type { Language } from "./language";
import { PageError, type SegmentRule } from "./manifest";

interface Cut {
  scores: Float64Array;
  gap: number;
  limit: number;
  taken: number;
  left: number;
}

export class Segments {
  /** Segment of each splat at the lowest level, and what the training views show of it. */
  readonly labels: Uint16Array | Uint32Array;
  readonly masses: Float64Array;
  /** Segment at each level of each lowest segment, the lowest level first. */
  readonly #levels: Uint32Array[];
  readonly #sums: Float64Array;
  /** 1 - u_G of each splat: low where the views disagree. */
  readonly #certainties: Float32Array;
  /** 1 for each splat that no view shows, 2 for those of fills; selections leave both out. */
  readonly hidden: Uint8Array;

  /** `content` is L and S, the levels [L, S], the labels [N], the masses [N], u_G [N] and `hidden` [N] (lexsplat.scenes.publishing.sidecar). */
  constructor(content: Uint8Array<ArrayBuffer>, count: number, readonly rule: SegmentRule) {
    const view = new DataView(content.buffer, content.byteOffset, content.byteLength);
    const levels = view.getUint32(0, true);
    const segments = view.getUint32(4, true);
    const wide = segments > 65536;
    let at = 8;
    if (content.length !== at + 4 * levels * segments + count * ((wide ? 4 : 2) + 4)) {
      throw new PageError("segments.bin: its length does not fit the scene; publish the scene again.");
    }
    const read = (length: number, bytes: number): ArrayBuffer => {
      at += length * bytes;
      return content.slice(at - length * bytes, at).buffer;
    };
    this.#levels = Array.from({ length: levels }, () => new Uint32Array(read(segments, 4)));
    this.labels = wide ? new Uint32Array(read(count, 4)) : new Uint16Array(read(count, 2));
    this.masses = Float64Array.from(new Uint16Array(read(count, 2)), (half) => DataUtils.fromHalfFloat(half));
    this.#certainties = Float32Array.from(new Uint8Array(read(count, 1)), (u) => 1 - u / 255);
    this.hidden = content.slice(at);
    this.#sums = new Float64Array(segments);
    this.labels.forEach((label, i) => (this.#sums[label] += this.masses[i]));
  }

  /** The mean distributions over K codes of all segments of all levels, one after the other. */
  distributions(language: Language): Float32Array {
    const { numCodes } = language;
    const own = new Float32Array(4);
    const lowest = new Float64Array(this.#sums.length * numCodes);
    this.labels.forEach((label, i) => {
      language.weights(i, own);
      for (let t = 0; t < 4; t++) lowest[label * numCodes + language.codes[4 * i + t]] += this.masses[i] * own[t];
    });
    const found = this.#levels.map((level) => {
      const count = level.reduce((most, segment) => Math.max(most, segment), 0) + 1;
      const means = new Float64Array(count * numCodes);
      const masses = new Float64Array(count);
      level.forEach((segment, s) => {
        masses[segment] += this.#sums[s];
        for (let k = 0; k < numCodes; k++) means[segment * numCodes + k] += lowest[s * numCodes + k];
      });
      return Float32Array.from(means, (value, i) => value / Math.max(masses[Math.floor(i / numCodes)], 1e-12));
    });
    const whole = new Float32Array(found.reduce((sum, part) => sum + part.length, 0));
    found.reduce((start, part) => (whole.set(part, start), start + part.length), 0);
    return whole;
  }

  /** Scores by segments from those of single splats: at least the threshold exactly where a segment is taken. */
  scores(own: Float32Array): Float32Array {
    const lowest = new Float64Array(this.#sums.length);
    const labels = this.labels;
    const masses = this.masses;
    for (let i = 0; i < own.length; i++) lowest[labels[i]] += masses[i] * own[i];
    let best: { cut: Cut; level: Uint32Array } | null = null;
    for (const level of [...this.#levels].reverse()) {
      const cut = cutOf(level, lowest, this.#sums, this.rule.lowest); // coarse levels first: of equal gaps the first one wins
      if (best === null || before(best.cut, cut, this.rule.border)) best = { cut, level };
    }
    const { cut, level } = best!;
    const { own_share: share, steepness, threshold, most_certain: most, below } = this.rule;
    const spread = Math.max(cut.taken - cut.left, 1e-6);
    // What all splats of a lowest segment share is computed once: a scene has millions of splats.
    const slope = steepness / spread;
    const means = lowest.map((sum, label) => sum / Math.max(this.#sums[label], 1e-12));
    const taken = Array.from(level, (segment) => cut.scores[segment] >= cut.limit);
    const pieces = piecesLeft(means, this.#sums, taken, this.rule);
    const scored = means.map((mean, label) => (pieces[label] ? mean : cut.scores[level[label]]));
    const shared = scored.map((score) => ((1 - share) * score - cut.limit) * slope);
    const floor = lowest.map((_, label) => threshold * Number(taken[label] || pieces[label]));
    // The own relevancy of a splat counts by how certain it is beside what is taken.
    let mass = 0;
    let certain = 0;
    for (let i = 0; i < own.length; i++) {
      if (!floor[labels[i]]) continue;
      mass += masses[i];
      certain += masses[i] * this.#certainties[i];
    }
    const usual = certain / Math.max(mass, 1e-12);
    const scores = new Float32Array(own.length);
    for (let i = 0; i < own.length; i++) {
      const counted = own[i] * share * (usual > 1e-6 ? Math.min(this.#certainties[i] / usual, most) : 1);
      const odds = Math.min(60, Math.max(-60, counted * slope + shared[labels[i]]));
      scores[i] = floor[labels[i]] + (below * (1 - threshold)) / (1 + Math.exp(-odds));
    }
    return scores;
  }
}

/** Whether the second cut answers better: what it takes lies above the border, then by its gap. */
function before(first: Cut, second: Cut, border: number): boolean {
  const [a, b] = [first.taken >= border, second.taken >= border];
  return a === b ? second.gap > first.gap : b;
}

/** The lowest segments that a cut leaves though they score higher than most of what it takes. */
function piecesLeft(means: Float64Array, masses: Float64Array, taken: boolean[], rule: SegmentRule): boolean[] {
  const inside = [...means.keys()].filter((label) => taken[label]).sort((a, b) => means[a] - means[b]);
  const running: number[] = [];
  for (const label of inside) running.push((running.at(-1) ?? 0) + masses[label]);
  const total = running.at(-1) ?? 0;
  const usual = means[inside[running.findIndex((sum) => sum >= rule.better * total)]];
  const pieces = taken.map((own, label) => !own && means[label] >= Math.max(usual, rule.border));
  const weight = masses.reduce((sum, mass, label) => sum + (pieces[label] ? mass : 0), 0);
  return pieces.map((piece) => piece && weight >= rule.enough * total && weight <= total);
}

/** The widest gap between the sorted scores of the segments of a level. */
function cutOf(level: Uint32Array, lowest: Float64Array, lowestMasses: Float64Array, share: number): Cut {
  const count = level.reduce((most, segment) => Math.max(most, segment), 0) + 1;
  const sums = new Float64Array(count);
  const masses = new Float64Array(count);
  level.forEach((segment, i) => {
    sums[segment] += lowest[i];
    masses[segment] += lowestMasses[i];
  });
  const scores = sums.map((sum, segment) => sum / Math.max(masses[segment], 1e-12));
  const ranked = scores.slice().sort().reverse();
  let place = 0;
  const gapAt = (n: number): number => (ranked[n] >= share * ranked[0] ? ranked[n] - ranked[n + 1] : -1);
  for (let n = 1; n + 1 < count; n++) if (gapAt(n) > gapAt(place)) place = n;
  const single = count === 1;
  const limit = single ? ranked[0] : (ranked[place] + ranked[place + 1]) / 2;
  const mean = (side: (score: number) => boolean): number => {
    let sum = 0;
    let mass = 0;
    scores.forEach((score, segment) => {
      if (!side(score)) return;
      sum += sums[segment];
      mass += masses[segment];
    });
    return sum / Math.max(mass, 1e-12);
  };
  if (single) return { scores, gap: 0, limit, taken: ranked[0], left: 0 };
  return { scores, gap: gapAt(place), limit, taken: mean((score) => score >= limit), left: mean((score) => score < limit) };
}
