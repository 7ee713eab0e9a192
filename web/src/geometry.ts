// The splats on the CPU: what a ray meets, and where a selection is. All points are in the axes of the scene.

import type { SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import type { SelectionRule } from "./manifest";
import { largest } from "./rules";

/** A selection's cluster: where it is and how large. */
export interface Place {
  center: THREE.Vector3;
  radius: number;
  splats: number[];
}

/** In `Geometry.hidden`, a splat of a fill: it is denser than what photos show, so its spacing does not count. */
const FILL = 2;
/** Splats that are linked, at most; the others of a larger selection join them. */
const MOST_LINKED = 20_000;

export class Geometry {
  readonly centers: Float32Array;
  readonly opacities: Float32Array;
  /** Opacity times area: how much of a picture each splat covers from a distance of one. */
  readonly covers: Float32Array;
  /** Red, green and blue of each splat, 0..1. */
  readonly colors: Float32Array;
  /** Brightness of each splat, 0..1. */
  readonly lights: Float32Array;
  /** Which splats no photo shows, as in `Segments`; null where that is not known. */
  hidden: Uint8Array | null = null;
  /** The listed object of each splat, a number without a size for none, and how many splats each object has. */
  listed: { of: Uint8Array; sizes: number[] } | null = null;
  readonly #scales: Float32Array;
  readonly #quats: Float32Array;

  constructor(mesh: SplatMesh, count: number, readonly rule: SelectionRule) {
    this.centers = new Float32Array(3 * count);
    this.opacities = new Float32Array(count);
    this.covers = new Float32Array(count);
    this.colors = new Float32Array(3 * count);
    this.lights = new Float32Array(count);
    this.#scales = new Float32Array(3 * count);
    this.#quats = new Float32Array(4 * count);
    const turn = mesh.quaternion.clone();
    const point = new THREE.Vector3();
    const quat = new THREE.Quaternion();
    mesh.forEachSplat((i, center, scales, quaternion, opacity, color) => {
      point.copy(center).applyQuaternion(turn).toArray(this.centers, 3 * i);
      scales.toArray(this.#scales, 3 * i);
      quat.copy(turn).multiply(quaternion).toArray(this.#quats, 4 * i);
      this.opacities[i] = opacity;
      const { x, y, z } = scales;
      this.covers[i] = (opacity * x * y * z) / Math.max(Math.min(x, y, z), 1e-12);
      this.colors.set([color.r, color.g, color.b], 3 * i);
      this.lights[i] = 0.2126 * color.r + 0.7152 * color.g + 0.0722 * color.b;
    });
  }

  get count(): number {
    return this.opacities.length;
  }

  center(splat: number, out = new THREE.Vector3()): THREE.Vector3 {
    return out.fromArray(this.centers, 3 * splat);
  }

  /** The middle of most splats and the radius around it that holds them. */
  bounds(): { center: THREE.Vector3; radius: number } {
    const step = Math.max(1, Math.floor(this.count / 20000));
    const firm = Array.from({ length: Math.ceil(this.count / step) }, (_, n) => n * step).filter((i) => this.opacities[i] >= this.rule.faint);
    const axis = (a: number): number[] => {
      const values = Float32Array.from(firm, (i) => this.centers[3 * i + a]).sort();
      return [values[Math.floor(values.length * 0.1)] ?? 0, values[Math.floor(values.length * 0.9)] ?? 0];
    };
    const [x, y, z] = [axis(0), axis(1), axis(2)];
    const center = new THREE.Vector3((x[0] + x[1]) / 2, (y[0] + y[1]) / 2, (z[0] + z[1]) / 2);
    return { center, radius: Math.hypot(x[1] - x[0], y[1] - y[0], z[1] - z[0]) / 2 || 1 };
  }

  /**
   * The surface that a ray meets: the depth behind which less than half of the light is left, and the splats there
   * with their shares of it. Null if the ray meets too little of a surface.
   */
  hit(ray: THREE.Ray): { point: THREE.Vector3; depth: number; splats: number[]; shares: number[] } | null {
    const { origin, direction } = ray;
    const met: { splat: number; depth: number; alpha: number }[] = [];
    const quat = new THREE.Quaternion();
    const toward = new THREE.Vector3();
    const offset = new THREE.Vector3();
    for (let i = 0, c = 0; i < this.count; i++, c += 3) {
      offset.set(this.centers[c] - origin.x, this.centers[c + 1] - origin.y, this.centers[c + 2] - origin.z);
      const along = offset.dot(direction);
      if (along <= 0) continue;
      const s = this.#scales;
      const reach = 3 * Math.max(s[c], s[c + 1], s[c + 2]);
      if (offset.lengthSq() - along * along > reach * reach) continue;
      quat.fromArray(this.#quats, 4 * i).conjugate();
      offset.applyQuaternion(quat).negate();
      toward.copy(direction).applyQuaternion(quat);
      for (const [n, axis] of (["x", "y", "z"] as const).entries()) {
        const scale = Math.max(s[c + n], 1e-7);
        offset[axis] /= scale;
        toward[axis] /= scale;
      }
      const depth = -offset.dot(toward) / toward.lengthSq();
      const apart = offset.lengthSq() - depth * depth * toward.lengthSq();
      const alpha = Math.min(0.99, this.opacities[i] * Math.exp(-0.5 * Math.max(0, apart)));
      if (alpha > 1 / 255 && depth > 0) met.push({ splat: i, depth, alpha });
    }
    met.sort((a, b) => a.depth - b.depth);
    let light = 1;
    const shares = met.map(({ alpha }) => {
      const share = light * alpha;
      light *= 1 - alpha;
      return share;
    });
    const total = 1 - light;
    if (total < this.rule.least_surface) return null;
    let sum = 0;
    const half = met[shares.findIndex((share) => (sum += share) >= total / 2)].depth;
    const near = met.map((_, n) => n).filter((n) => Math.abs(met[n].depth - half) <= this.rule.same_surface * half);
    return {
      point: ray.at(half, new THREE.Vector3()),
      depth: half,
      splats: near.map((n) => met[n].splat),
      shares: near.map((n) => shares[n]),
    };
  }

  /**
   * The places that a threshold selects, the surest first: connected cells of a grid, without specks and without
   * clusters of which these scores are far worse than those of the best one; null compares none. Clusters of one listed
   * object are one place: a lamp and its stand.
   */
  places(scores: Float32Array, threshold: number, compared: Float32Array | null = scores): Place[] {
    const chosen: number[] = [];
    for (let i = 0; i < this.count; i++) if (scores[i] >= threshold) chosen.push(i);
    if (chosen.length === 0) return [];
    const clusters = this.#united(this.#clusters(chosen)).map((splats) => ({
      splats,
      mass: splats.reduce((sum, i) => sum + this.opacities[i], 0),
      peak: this.#peak(scores, splats),
    }));
    const most = Math.max(...clusters.map((cluster) => cluster.mass));
    const firm = clusters.filter((cluster) => cluster.mass >= this.rule.smallest_share * most);
    const heights = firm.map(({ splats, peak }) => (compared === scores ? peak : this.#peak(compared ?? scores, splats)));
    const best = odds(Math.max(...heights));
    const limit = Math.min(best, odds(threshold) + this.rule.convincing * (best - odds(threshold)));
    return firm
      .filter((_, n) => !compared || odds(heights[n]) >= limit)
      .sort((a, b) => b.peak * Math.sqrt(b.mass) - a.peak * Math.sqrt(a.mass))
      .map(({ splats }) => this.place(splats));
  }

  /** Clusters, of which those of one listed object are one if they hold most of it: two wheels of a car are two. */
  #united(clusters: number[][]): number[][] {
    const { listed } = this;
    if (!listed || clusters.length < 2) return clusters;
    const own = clusters.map((cluster) => {
      const counts = listed.sizes.map(() => 0);
      for (const i of cluster) if (listed.of[i] < counts.length) counts[listed.of[i]]++;
      const most = counts.indexOf(Math.max(0, ...counts));
      return 2 * (counts[most] ?? 0) > cluster.length ? { object: most, count: counts[most] } : null;
    });
    const held = listed.sizes.map((_, object) => own.reduce((sum, each) => sum + (each?.object === object ? each.count : 0), 0));
    const places = new Map<number, number[]>();
    const found: number[][] = [];
    clusters.forEach((cluster, n) => {
      const object = own[n]?.object;
      const whole = object !== undefined && 2 * held[object] > listed.sizes[object];
      const place = whole ? places.get(object) : undefined;
      if (place) {
        for (const i of cluster) place.push(i);
        return;
      }
      const kept = [...cluster];
      if (whole) places.set(object, kept);
      found.push(kept);
    });
    return found;
  }

  #peak(scores: Float32Array, splats: number[]): number {
    return mean(largest(scores, splats, this.rule.peak_count).map((i) => scores[i]));
  }

  /** The place where scores are best, however low they are. */
  best(scores: Float32Array): Place[] {
    const { evidence_share, evidence_count } = this.rule;
    const firm = Array.from(scores.keys()).filter((i) => this.opacities[i] >= this.rule.evidence_faint);
    const chosen = largest(scores, firm, Math.max(evidence_count, Math.floor(evidence_share * firm.length)));
    return chosen.length ? this.places(scores, Math.max(1e-4, scores[chosen.at(-1)!])).slice(0, 1) : [];
  }

  /**
   * Splats that are linked: nearer than 2.5 times the usual distance to the sixth neighbor. Faint splats, and of large
   * selections those that are not in a sample, join the cluster of a near one.
   */
  #clusters(chosen: number[]): number[][] {
    const firm = chosen.filter((i) => this.opacities[i] >= this.rule.faint);
    const all = firm.length ? firm : chosen;
    const step = Math.ceil(all.length / MOST_LINKED);
    const makers = step > 1 ? all.filter((_, n) => n % step === 0) : all;
    const usual = this.hidden ? makers.filter((i) => this.hidden![i] !== FILL) : makers;
    const link = this.rule.link * this.spacing(usual.length ? usual : makers);
    const grid = new Grid(this.centers, makers, link);
    const parents = new Map<number, number>(makers.map((i) => [i, i]));
    const root = (i: number): number => {
      let top = i;
      for (let up = parents.get(top)!; up !== top; up = parents.get(top)!) top = up;
      for (let up = parents.get(i)!; up !== top; up = parents.get(i)!) {
        parents.set(i, top);
        i = up;
      }
      return top;
    };
    for (const i of makers) grid.near(i, (j) => j < i && parents.set(root(i), root(j)) && false);
    const clusters = new Map<number, number[]>(makers.map((i) => [root(i), []]));
    for (const i of makers) clusters.get(root(i))!.push(i);
    let apart = chosen.filter((i) => !parents.has(i));
    for (let reach = link; apart.length > 0 && reach < Infinity; reach = Math.max(4 * reach, 1e-6)) {
      const wider = reach === link ? grid : new Grid(this.centers, makers, reach);
      apart = apart.filter((i) => !wider.near(i, (j) => clusters.get(root(j))!.push(i) > 0));
    }
    return [...clusters.values()];
  }

  /** Some splats in cubes, to find those within a distance. */
  grid(splats: number[], side: number): Grid {
    return new Grid(this.centers, splats, side);
  }

  /** Median distance to the sixth neighbor, of a sample. */
  spacing(splats: number[]): number {
    const step = Math.max(1, Math.ceil((splats.length * splats.length) / 4e6));
    const found: number[] = [];
    for (let n = 0; n < splats.length; n += step) {
      const nearest = new Array<number>(7).fill(Infinity); // itself and six others
      for (const j of splats) {
        const apart = squared(this.centers, splats[n], j);
        if (apart >= nearest[6]) continue;
        let place = 6;
        for (; place > 0 && nearest[place - 1] > apart; place--) nearest[place] = nearest[place - 1];
        nearest[place] = apart;
      }
      found.push(Math.sqrt(nearest.findLast(Number.isFinite) ?? 0));
    }
    found.sort((a, b) => a - b);
    return found[Math.floor(found.length / 2)] || Math.max(...this.#scales.subarray(3 * splats[0], 3 * splats[0] + 3));
  }

  /** Mean brightness of some splats. */
  light(splats: number[]): number {
    let [sum, weight] = [0, 0];
    for (const i of splats) {
      sum += this.lights[i] * this.opacities[i];
      weight += this.opacities[i];
    }
    return sum / (weight || 1);
  }

  /** Where some splats are: their middle and the radius that holds most of them. */
  place(splats: number[]): Place {
    const center = new THREE.Vector3();
    const point = new THREE.Vector3();
    let sum = 0;
    for (const i of splats) {
      center.addScaledVector(this.center(i, point), this.opacities[i]);
      sum += this.opacities[i];
    }
    center.divideScalar(sum || 1);
    const apart = splats.map((i) => this.center(i, point).distanceTo(center)).sort((a, b) => a - b);
    return { center, radius: apart[Math.floor(apart.length * 0.95)] || 0.01, splats };
  }
}

/** Log-odds, finite for 0 and 1. */
function odds(score: number): number {
  const within = Math.min(1 - 1e-6, Math.max(1e-6, score));
  return Math.log(within / (1 - within));
}

function squared(centers: Float32Array, i: number, j: number): number {
  const x = centers[3 * i] - centers[3 * j];
  const y = centers[3 * i + 1] - centers[3 * j + 1];
  const z = centers[3 * i + 2] - centers[3 * j + 2];
  return x * x + y * y + z * z;
}

/** Splats in cubes, to find those within a distance. */
export class Grid {
  readonly #cells = new Map<number, number[]>();

  constructor(readonly centers: Float32Array, splats: number[], readonly side: number) {
    for (const i of splats) {
      const key = this.#key(i, 0, 0, 0);
      const cell = this.#cells.get(key);
      if (cell) cell.push(i);
      else this.#cells.set(key, [i]);
    }
  }

  /** Visit the splats within one side of a splat, until `visit` is true; whether it was. */
  near(splat: number, visit: (other: number) => boolean): boolean {
    const limit = this.side * this.side;
    for (let n = 0; n < 27; n++) {
      const cell = this.#cells.get(this.#key(splat, (n % 3) - 1, (Math.floor(n / 3) % 3) - 1, Math.floor(n / 9) - 1));
      for (const other of cell ?? []) if (squared(this.centers, splat, other) <= limit && visit(other)) return true;
    }
    return false;
  }

  /** A number for each cube within 2^16 sides of the origin; cubes farther away share numbers. */
  #key(splat: number, x: number, y: number, z: number): number {
    const at = (axis: number, shift: number): number =>
      ((Math.floor(this.centers[3 * splat + axis] / this.side) + shift) & 0x1ffff) >>> 0;
    return (at(0, x) * 0x20000 + at(1, y)) * 0x20000 + at(2, z);
  }
}

function mean(values: number[]): number {
  return values.reduce((a, b) => a + b, 0) / (values.length || 1);
}
