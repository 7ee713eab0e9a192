// Which splats are drawn where a scene has more than a browser draws well: those that matter most from the camera.

import * as THREE from "three";
import type { Geometry } from "./geometry";
import type { Manifest } from "./manifest";

/** Share of the budget for the splats that cover most of the whole scene: they are there when the camera turns. */
const ANYWHERE = 0.25;
/** How far out of the picture splats still count: 1 is its border. */
const MARGIN = 1.3;
/** Steps of the histogram for each doubling of what a splat covers. */
const STEPS = 16;
const BINS = 128 * STEPS;

export class Budget {
  /** 1 for each splat that is left out. */
  readonly out: Uint8Array;
  readonly #worth: Float32Array;
  readonly #anywhere: Uint8Array;

  constructor(readonly geometry: Geometry, readonly most: number) {
    this.out = new Uint8Array(geometry.count);
    this.#worth = new Float32Array(geometry.count);
    geometry.covers.forEach((covers, i) => (this.#worth[i] = covers));
    this.#anywhere = best(this.#worth, Math.floor(most * ANYWHERE), new Uint8Array(geometry.count));
  }

  /** The budget of a scene; null where all its splats are drawn. */
  static needed(geometry: Geometry, most: number): Budget | null {
    return geometry.count > most ? new Budget(geometry, most) : null;
  }

  /** Choose for a camera: by opacity times area over squared distance, of what is in the picture or near it. */
  choose(camera: THREE.PerspectiveCamera): Uint8Array {
    camera.updateMatrixWorld();
    const m = camera.matrixWorldInverse.elements;
    const [tall, wide] = [1 / camera.projectionMatrix.elements[5], 1 / camera.projectionMatrix.elements[0]];
    const { centers, covers } = this.geometry;
    for (let i = 0, c = 0; i < covers.length; i++, c += 3) {
      const [x, y, z] = [centers[c], centers[c + 1], centers[c + 2]];
      const depth = -(m[2] * x + m[6] * y + m[10] * z + m[14]);
      const reach = MARGIN * depth + 3 * Math.sqrt(covers[i]);
      const seen =
        depth > camera.near &&
        Math.abs(m[0] * x + m[4] * y + m[8] * z + m[12]) < wide * reach &&
        Math.abs(m[1] * x + m[5] * y + m[9] * z + m[13]) < tall * reach;
      this.#worth[i] = seen ? covers[i] / (depth * depth) : 0;
    }
    const drawn = best(this.#worth, this.most, this.#anywhere.slice());
    for (let i = 0; i < drawn.length; i++) this.out[i] = 1 - drawn[i];
    return this.out;
  }
}

/** Mark with 1, beside those that are marked, the splats that are worth most, until `most` are. */
export function best(worth: Float32Array, most: number, marked: Uint8Array): Uint8Array {
  let left = most;
  const counts = new Uint32Array(BINS);
  const bin = (value: number): number => Math.min(BINS - 1, Math.max(0, Math.floor((Math.log2(value) + 64) * STEPS)));
  for (let i = 0; i < worth.length; i++) {
    if (marked[i]) left--;
    else if (worth[i] > 0) counts[bin(worth[i])]++;
  }
  let last = BINS;
  while (last > 0 && counts[last - 1] <= left) left -= counts[--last];
  for (let i = 0; i < worth.length; i++) {
    if (marked[i] || !(worth[i] > 0)) continue;
    const place = bin(worth[i]);
    if (place >= last || (place === last - 1 && left-- > 0)) marked[i] = 1;
  }
  return marked;
}

/** What is not drawn, in a sentence for each reason; "" if all is. */
export function leftOut({ gaussians, of, budget }: Manifest["scene"]): string {
  const n = (count: number): string => count.toLocaleString("en");
  const sent = of > gaussians ? `This page holds ${n(gaussians)} of the scene's ${n(of)} Gaussians. ` : "";
  return sent + (gaussians > budget ? `The page leaves out ${n(gaussians - budget)} of ${n(gaussians)}: those that cover least of the picture from here.` : "");
}
