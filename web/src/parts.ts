// Parts of things are cut within their thing: lexsplat.queries.parts in the browser. tests/scenes/test_published_page.py
// compares the scores.

import type { Geometry } from "./geometry";
import type { PartRule } from "./manifest";

/** A thing with the segments beside it that are taken for a part of it: a bottle may be found without its cork. */
export function withParts(thing: number[], taken: number[], geometry: Geometry, labels: ArrayLike<number>): number[] {
  const inside = new Set(thing);
  const others = taken.filter((i) => !inside.has(i));
  if (others.length === 0) return thing;
  const reach = geometry.rule.link * geometry.spacing(thing);
  const near = new Set<number>();
  const grid = geometry.grid(thing, reach);
  for (const i of others) if (!near.has(labels[i])) grid.near(i, () => near.add(labels[i]) !== null);
  return [...thing, ...others.filter((i) => near.has(labels[i]))].sort((a, b) => a - b);
}

/**
 * Scores of a part: at least 0.5 exactly in it; null if nearly all of its thing is described as the part. `own` are the relevancies of single splats, `thing` the splats of its
 * thing, and `masses` what the training views show of each splat.
 */
export function partScores(own: Float32Array, thing: number[], geometry: Geometry, masses: Float64Array, rule: PartRule): Float32Array | null {
  const weights = Float64Array.from(thing, (i) => masses[i]);
  const values = Float64Array.from(thing, (i) => own[i]);
  const links = weighted(values, thing, geometry, weights, rule);
  let smooth = values;
  for (let round = 0; round < rule.rounds; round++) {
    const before = smooth;
    smooth = values.map((value, n) => (1 - rule.shared) * value + rule.shared * around(links[n], before));
  }
  const found = cut(smooth, weights, rule);
  if (found.lowest >= rule.all) return null;
  const { base, border, best } = found;
  const part = grown(smooth, base, border, links, rule);
  const scores = Float32Array.from(own, (score) => (rule.outside * Math.min(score / border, 1)) / 2);
  thing.forEach((splat, n) => {
    const inside = rule.firm + (1 - rule.firm) * Math.min(Math.max((smooth[n] - border) / Math.max(best - border, 1e-6), 0), 1);
    scores[splat] = (part[n] ? 1 + inside : Math.min(smooth[n] / border, 1 - 1e-4)) / 2;
  });
  return scores;
}

type Link = [other: number, weight: number];

/** The mean of numbers over the neighbors of a splat. */
const around = (links: Link[], numbers: Float64Array): number => links.reduce((sum, [m, weight]) => sum + weight * numbers[m], 0);

/** Links to neighbors, by how alike their colors and `values` are; those of a splat add up to 1. */
function weighted(values: Float64Array, thing: number[], geometry: Geometry, weights: Float64Array, rule: PartRule): Link[][] {
  const { colors } = geometry;
  return linked(thing, geometry.centers, rule.neighbors).map((others, n) => {
    const links = [...others].map((m): Link => {
      let apart = ((values[n] - values[m]) / rule.score) ** 2;
      for (let c = 0; c < 3; c++) apart += ((colors[3 * thing[n] + c] - colors[3 * thing[m] + c]) / rule.color) ** 2;
      return [m, Math.exp(-apart) * weights[m]];
    });
    const total = Math.max(links.reduce((sum, [, weight]) => sum + weight, 0), 1e-9);
    return links.map(([m, weight]): Link => [m, weight / total]);
  });
}

/** The part: from the border on, and what random walks add to it where that makes its border much shorter. */
function grown(smooth: Float64Array, base: number, border: number, links: Link[][], rule: PartRule): boolean[] {
  const isBetween = (n: number): boolean => smooth[n] < border && smooth[n] > base;
  const between = Array.from(smooth.keys()).filter(isBetween);
  const reached = smooth.map((score, n) => (score >= border ? 1 : isBetween(n) ? (score - base) / Math.max(border - base, 1e-9) / 2 : 0));
  for (let step = 0; step < rule.walked; step++) {
    const next = between.map((n) => around(links[n], reached));
    between.forEach((n, place) => (reached[n] = next[place]));
  }
  const order = Array.from(reached.keys()).sort((a, b) => reached[b] - reached[a] || a - b);
  const rank = new Float64Array(order.length);
  order.forEach((n, place) => (rank[n] = place));
  // A link crosses the border of those of the first splats that have one of its ends.
  const change = new Float64Array(order.length + 1);
  links.forEach((own, n) => {
    for (const [m, weight] of own) {
      if (rank[m] >= rank[n]) continue;
      change[rank[m]] += weight;
      change[rank[n]] -= weight;
    }
  });
  const isPart = Array.from(smooth, (score) => score >= border);
  const count = isPart.filter(Boolean).length;
  let [size, fewest, most, crossing] = [0, Infinity, Infinity, 0];
  order.forEach((n, place) => {
    crossing += change[place];
    const length = Math.max(crossing, rule.short);
    if (place + 1 === count) most = rule.shorter * length;
    if (place + 1 >= count && reached[n] >= rule.nearest && length < fewest) [size, fewest] = [place + 1, length];
  });
  if (fewest > most) return isPart;
  return isPart.map((is, n) => is || rank[n] < size);
}

/** The neighbors of each splat: the nearest ones, and those that it is one of the nearest of. */
function linked(thing: number[], centers: Float32Array, neighbors: number): Set<number>[] {
  const spans = [0, 1, 2].map((axis) => {
    const [low, high] = thing.reduce(([a, b], i) => [Math.min(a, centers[3 * i + axis]), Math.max(b, centers[3 * i + axis])], [Infinity, -Infinity]);
    return high - low;
  });
  const axis = spans.indexOf(Math.max(...spans));
  const along = (n: number): number => centers[3 * thing[n] + axis];
  const order = thing.map((_, n) => n).sort((a, b) => along(a) - along(b));
  const links = thing.map(() => new Set<number>());
  order.forEach((n, place) => {
    const nearest: { m: number; apart: number }[] = [];
    const visit = (m: number): boolean => {
      const most = nearest.length < neighbors ? Infinity : nearest[neighbors - 1].apart;
      if ((along(m) - along(n)) ** 2 > most) return false; // and so are all beyond it
      let apart = 0;
      for (let c = 0; c < 3; c++) apart += (centers[3 * thing[m] + c] - centers[3 * thing[n] + c]) ** 2;
      if (apart < most) {
        nearest.splice(nearest.findLastIndex((other) => other.apart <= apart) + 1, 0, { m, apart });
        nearest.length = Math.min(nearest.length, neighbors);
      }
      return true;
    };
    let [down, up] = [place - 1, place + 1];
    while (down >= 0 || up < order.length) {
      if (down >= 0 && !visit(order[down--])) down = -1;
      if (up < order.length && !visit(order[up++])) up = order.length;
    }
    for (const { m } of nearest) {
      links[n].add(m);
      links[m].add(n);
    }
  });
  return links;
}

/** The score of what is no part, the lowest one of the part, its best one, and the lowest of the thing. */
function cut(scores: Float64Array, weights: Float64Array, rule: PartRule): { base: number; border: number; best: number; lowest: number } {
  const order = Array.from(scores.keys()).sort((a, b) => scores[a] - scores[b] || a - b);
  const ranked = order.map((n) => scores[n]);
  let sum = 0;
  const reached = order.map((n) => (sum += weights[n]));
  const total = sum;
  const top = ranked.slice(-rule.best);
  const best = top.reduce((all, score) => all + score, 0) / top.length;
  const quantile = (share: number): number => ranked[Math.min(firstAt(reached, share * total), ranked.length - 1)];
  const above = (limit: number): number => total - (reached[firstAt(ranked, limit) - 1] ?? 0);
  const lowest = quantile(rule.lowest);
  const median = quantile(0.5);
  const base = median - lowest > rule.mostly * (best - lowest) ? lowest : median;
  let found = { cost: Infinity, border: 0 };
  for (let step = 0; step < rule.steps; step++) {
    const place = rule.first + (step / (rule.steps - 1)) * (rule.last - rule.first);
    const limit = base + place * (best - base);
    const reach = rule.near * (best - base);
    const near = (above(limit - reach) - above(limit + reach)) / Math.max(above(limit), 1e-9);
    const cost = Math.log(near + rule.few) + (place - rule.usual) ** 2 / (2 * rule.spread ** 2);
    if (cost < found.cost) found = { cost, border: limit };
  }
  return { base, border: Math.max(found.border, 1e-6), best, lowest };
}

/** The first place of sorted values that is at least a value; their number if there is none. */
function firstAt(values: ArrayLike<number>, value: number): number {
  let [low, high] = [0, values.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] < value) low = middle + 1;
    else high = middle;
  }
  return low;
}
