// Kinds of things, such as "toy": answered by the objects of the scene that are of the kind (lexsplat.queries.kinds).

import type { Answer } from "./answers";
import type { Geometry, Place } from "./geometry";
import { type ObjectEntry, PageError } from "./manifest";

export class Kinds {
  readonly #members: ReadonlyMap<string, number[]>;
  readonly #names: string[];
  readonly #places: Place[];

  /** `content` is the place of each splat in the list of objects, [N] uint8, 255 for none. */
  constructor(content: Uint8Array, geometry: Geometry, objects: ObjectEntry[], members: Record<string, number[]>) {
    if (content.length !== geometry.count) {
      throw new PageError("objects.bin: its length does not fit the scene; publish the scene again.");
    }
    this.#members = new Map(Object.entries(members));
    this.#names = objects.map(({ name }) => name);
    const used = new Set(Object.values(members).flat());
    const splats: number[][] = objects.map(() => []);
    content.forEach((place, i) => used.has(place) && splats[place]?.push(i));
    this.#places = splats.map((own) => geometry.place(own));
  }

  has(phrase: string): boolean {
    return this.#members.has(phrase);
  }

  /** The objects of a kind; `plain` is the answer to its name as a phrase. */
  answer(kind: string, plain: Answer): Answer {
    const members = this.#members.get(kind)!.filter((place) => this.#places[place]?.splats.length);
    if (members.length === 0) return plain;
    const scores = plain.scores.slice();
    const places = members.map((place) => this.#places[place]);
    for (const { splats } of places) for (const splat of splats) scores[splat] = 1;
    const names = [...new Set(members.map((place) => this.#names[place]))];
    return { ...plain, phrase: kind, scores, presence: "yes", members: places, places, note: names.join(", ") };
  }
}
