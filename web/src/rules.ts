// "Not here" and relevancy for phrases that are in no dictionary, relative to everyday words as
// lexsplat.queries.everyday and lexsplat.queries.presence have it. tests/scenes/test_published_page.py compares them.

import { type Language, type Table, dot } from "./language";
import type { EverydayRule, SelectionRule } from "./manifest";

export type Presence = "yes" | "no" | "unsure";

/** Keeps quotients finite. */
const LEAST = 1e-6;

/** How well a phrase describes each code, above its own offset. */
export type Heights = Float32Array;

/**
 * Heights of a phrase: its cosines with the codes, less those of the mean everyday word, less their quantile.
 * `codewords` is [K, D] of unit length, `text` and `mean` are [D].
 */
export function heightsOf(codewords: Float32Array, text: Float32Array, mean: Float32Array, rule: EverydayRule): Heights {
  const width = text.length;
  const shared = new Float32Array(codewords.length / width);
  for (let k = 0; k < shared.length; k++) {
    let sum = 0;
    for (let d = 0; d < width; d++) sum += codewords[k * width + d] * (text[d] - mean[d]);
    shared[k] = sum;
  }
  const sorted = shared.slice().sort();
  const place = rule.offset * (sorted.length - 1);
  const low = Math.floor(place);
  const offset = sorted[low] + (place - low) * (sorted[Math.min(low + 1, sorted.length - 1)] - sorted[low]);
  return shared.map((value) => value - offset);
}

/** Relevancy of each code for a phrase with these heights; `best` has the heights that it is compared with there. */
export function relevancyOf(heights: Heights, best: Float32Array, rule: EverydayRule): Table {
  const peak = highest(heights, rule);
  return heights.map((height, k) => {
    const ratio = Math.min(height / peak, height / best[k]);
    return 1 / (1 + Math.exp(-rule.steepness * (ratio - rule.border)));
  });
}

/** The best height of a phrase: the mean of the largest. */
function highest(heights: Heights, rule: EverydayRule): number {
  const count = Math.max(1, Math.round(rule.peak_share * heights.length));
  const largest = heights.slice().sort().subarray(-count);
  return Math.max(LEAST, largest.reduce((sum, value) => sum + value, 0) / count);
}

/** What a part is compared with at each code: everyday words, and its thing by shares of their best heights. */
export function besideThing(part: Heights, thing: Heights, best: Float32Array, rule: EverydayRule): Float32Array {
  const share = highest(part, rule) / highest(thing, rule);
  return best.map((height, k) => {
    const ofThing = Math.max(LEAST, thing[k]) * share;
    return Math.max(rule.border_part * height, rule.over_thing * ofThing) / rule.border;
  });
}

/** A word in the singular, as far as names of parts need it. */
function bareWord(word: string): string {
  return { leaves: "leaf", feet: "foot" }[word] ?? word.replace(/s$/, "");
}

/** Whether a phrase names a part of a thing: the everyday name of the thing, and then another word. */
export function isPart(phrase: string, rule: EverydayRule): boolean {
  const words = phrase.toLowerCase().split(/\s+/).map(bareWord);
  const last = words.pop()!;
  const named = rule.parts.includes(last) || (!rule.names.includes(last) && !rule.qualities.includes(last));
  return named && words.some((word) => rule.names.includes(word));
}

/** The thing of which a phrase names a part; empty if it names none of the rule's parts. */
export function thingOfPart(phrase: string, rule: EverydayRule): string {
  const words = phrase.toLowerCase().split(/\s+/);
  const bare = words.map(bareWord);
  if (!isPart(phrase, rule) || !rule.parts.includes(bare.at(-1)!)) return "";
  return words.slice(0, bare.slice(0, -1).findLastIndex((word) => rule.names.includes(word)) + 1).join(" ");
}

/** Whether a phrase is one of the rule's parts without its thing, such as "handle". */
export function isPartAlone(phrase: string, rule: EverydayRule): boolean {
  return rule.parts.includes(bareWord(phrase.toLowerCase()));
}

/** Whether another part fits a place, a distribution [K], better than the one that a phrase names; `fits` is [W, K]. */
export function isDoubtful(phrase: string, place: Float32Array, fits: Float32Array, rule: EverydayRule): boolean {
  const part = bareWord(phrase.toLowerCase().split(/\s+/).at(-1)!);
  const alike = rule.alike.find((group) => group.includes(part)) ?? [part];
  const at = (name: number): number => Math.max(0, dot(place, fits.subarray(name * place.length, (name + 1) * place.length)));
  const own = Math.max(...alike.map((name) => at(rule.parts.indexOf(name))));
  return rule.parts.some((name, n) => !alike.includes(name) && at(n) > rule.rival * own);
}

export function hasColor(phrase: string, rule: EverydayRule): boolean {
  return phrase.toLowerCase().split(/\s+/).some((word) => rule.colors.includes(word));
}

/** The mean distribution of the splats that score best. */
export function peakOf(scores: Float32Array, language: Language, shown: Uint32Array, rule: SelectionRule): Float32Array {
  const count = Math.min(shown.length, Math.max(rule.evidence_count, Math.floor(rule.evidence_share * shown.length)));
  return language.distribution(largest(scores, shown, count));
}

/** How well a phrase describes each of some places, distributions [V, K]. */
export function strengthsOf(heights: Heights, places: Float32Array, best: Float32Array, rule: EverydayRule): number[] {
  const count = heights.length;
  const strengths: number[] = [];
  for (let start = 0; start < places.length; start += count) {
    const place = places.subarray(start, start + count);
    const reached = dot(place, heights);
    const ratio = Math.max(0, reached / Math.max(dot(place, best), LEAST));
    strengths.push(Math.sqrt(ratio * Math.max(0, Math.min(ratio, reached / rule.peak))));
  }
  return strengths;
}

/** Whether the scene holds a phrase, from how well it describes each of some places. */
export function presenceOf(strengths: number[], yes: number, no: number): Presence {
  const strength = strengths.reduce((most, value) => Math.max(most, value), 0);
  return strength >= yes ? "yes" : strength < no ? "no" : "unsure";
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
