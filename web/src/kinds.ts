// Kinds of things, such as "toy", and things in a color: answered by the objects of the scene (lexsplat.queries.kinds).

import type { Found } from "./answers";
import { singulars } from "./dictionary";
import type { Geometry, Place } from "./geometry";
import { type ObjectEntry, PageError } from "./manifest";

/** Score of an object that is the answer, where language has less, as in lexsplat.scenes.words. */
const MEMBER = 0.9;
/** Share of an object of its name from which a word is that object, as there. */
const PIECE = 0.3;
/** Share of an object of its noun from which a phrase with a quality is that object, as there. */
const MOSTLY = 0.7;

export class Kinds {
  readonly #members: ReadonlyMap<string, number[]>;
  readonly #objects: ObjectEntry[];
  #places: Place[] | null = null;

  /** `content` is the place of each splat in the list of objects, [N] uint8, 255 for none. */
  constructor(
    readonly content: Uint8Array, readonly geometry: Geometry, objects: ObjectEntry[], members: Record<string, number[]>,
  ) {
    if (content.length !== geometry.count) {
      throw new PageError("objects.bin: its length does not fit the scene; publish the scene again.");
    }
    this.#members = new Map(Object.entries(members));
    this.#objects = objects;
    const sizes = objects.map(() => 0);
    for (const place of content) if (place < sizes.length) sizes[place]++;
    geometry.listed = { of: content, sizes };
  }

  get names(): string[] {
    return this.#objects.map(({ name }) => name);
  }

  entry(place: number): ObjectEntry {
    return this.#objects[place];
  }

  has(kind: string): boolean {
    return this.#members.has(kind);
  }

  /**
   * The objects of a kind, "" for any; with `color`, those of this main color, or else those that have it as well.
   * Null if there are none. `plain` are the scores of the other splats.
   */
  find(kind: string, color: string, plain: Float32Array | null): Pick<Found, "scores" | "presence" | "places" | "members" | "note"> | null {
    this.#places ??= this.#found();
    const all = (this.#members.get(kind) ?? []).filter((place) => this.#places![place]?.splats.length);
    const inColor = (most: number): number[] => all.filter((place) => this.#objects[place].colors?.slice(0, most).includes(color));
    const main = color ? inColor(1) : all;
    if (main.length) return this.#answer(main, plain);
    const also = this.#answer(inColor(Infinity), plain);
    return also && { ...also, presence: "unsure", note: `no ${kind || "thing"} is mainly ${color}` };
  }

  /** The places of the objects with a noun, given its singulars; of "stack of books" stack and book. */
  named(nouns: string[]): number[] {
    const own = (name: string): string[] => [name.split(" of ")[0], name].map((words) => words.split(" ").at(-1)!);
    const isOne = (name: string): boolean => own(name).some((noun) => singulars(noun).some((form) => nouns.includes(form)));
    return [...this.#objects.keys()].filter((place) => isOne(this.#objects[place].name));
  }

  /**
   * Scores with all of each of some objects of which much is taken, and without the little that is taken of other
   * things, much of things that no noun names, and what is no object (completed in lexsplat.scenes.words).
   * `isSurface` tells surfaces, `carries` those of them that carry things.
   */
  completed(
    scores: Float32Array, taken: number[], named: number[], nouns: string[],
    isSurface: (name: string) => boolean, carries: (name: string) => boolean,
  ): Float32Array {
    this.#places ??= this.#found();
    const isTaken = new Set(taken);
    const isMuch = (splats: number[]): boolean => splats.length > 0 && splats.filter((i) => isTaken.has(i)).length >= PIECE * splats.length;
    const found = named.filter((place) => isMuch(this.#places![place].splats));
    if (found.length === 0) return scores;
    const result = scores.slice();
    const border = this.geometry.rule.threshold - 1e-4;
    for (const place of found) {
      for (const i of this.#places[place].splats) if (!isTaken.has(i)) result[i] = Math.max(result[i], MEMBER);
    }
    const leave = (splats: number[]): void => {
      for (const i of splats) if (isTaken.has(i)) result[i] = Math.min(result[i], border);
    };
    this.#places.forEach(({ splats }, place) => {
      const { name, nouns: own } = this.#objects[place];
      if (named.includes(place)) return;
      const isStranger = own !== undefined && !isSurface(name) && !own.some((noun) => nouns.includes(noun));
      if (isMuch(splats) ? isStranger : !isSurface(name) || carries(name)) leave(splats);
    });
    if (!found.some((place) => isSurface(this.#objects[place].name))) {
      leave(taken.filter((i) => this.content[i] >= this.#objects.length));
    }
    return result;
  }

  /** Whether some splats are nearly all of what views show of an object: a green bottle has a cork, too. */
  isMostly(place: number, taken: number[], masses: ArrayLike<number>): boolean {
    this.#places ??= this.#found();
    const isTaken = new Set(taken);
    const { splats } = this.#places[place];
    const shown = (of: number[]): number => of.reduce((sum, i) => sum + masses[i], 0);
    return shown(splats.filter((i) => isTaken.has(i))) >= MOSTLY * shown(splats);
  }

  /** The places of the objects of which some splats are at least half. */
  covered(splats: number[]): number[] {
    const counts = this.#objects.map(() => 0);
    for (const i of splats) if (this.content[i] < counts.length) counts[this.content[i]]++;
    const sizes = this.#objects.map(() => 0);
    for (const place of this.content) if (place < sizes.length) sizes[place]++;
    return [...counts.keys()].filter((place) => counts[place] > 0 && 2 * counts[place] >= sizes[place]);
  }

  /** Of some objects those that are mostly in one of some colors; null if there are none. */
  inColors(listed: number[], colors: string[], plain: Float32Array): ReturnType<Kinds["find"]> {
    this.#places ??= this.#found();
    const all = listed.filter((place) => colors.includes(this.#objects[place].colors?.[0] ?? "") && this.#places![place].splats.length);
    const found = this.#answer(all, plain);
    return found && { ...found, note: "" };
  }

  #answer(members: number[], plain: Float32Array | null): ReturnType<Kinds["find"]> {
    if (members.length === 0) return null;
    const { threshold } = this.geometry.rule;
    const scores = plain?.map((score) => Math.min(score, threshold - 1e-4)) ?? new Float32Array(this.geometry.count);
    const places = members.map((place) => this.#places![place]);
    for (const { splats } of places) for (const splat of splats) scores[splat] = plain ? Math.max(plain[splat], MEMBER) : 1;
    const names = [...new Set(members.map((place) => this.#objects[place].name))];
    return { scores, presence: "yes", members: places, places, note: names.join(", ") };
  }

  /** The objects that each have at least this share of some splats. */
  holding(splats: number[], share: number): ObjectEntry[] {
    const counts = this.#objects.map(() => 0);
    for (const i of splats) if (this.content[i] < counts.length) counts[this.content[i]]++;
    return this.#objects.filter((_, place) => splats.length > 0 && counts[place] >= share * splats.length);
  }

  #found(): Place[] {
    const splats: number[][] = this.#objects.map(() => []);
    this.content.forEach((place, i) => splats[place]?.push(i));
    return splats.map((own) => this.geometry.place(own));
  }
}
