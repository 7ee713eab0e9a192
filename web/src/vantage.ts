// Where to look at a place from.

import * as THREE from "three";
import type { Geometry, Place } from "./geometry";
import type { ViewEntry } from "./manifest";
import { pose } from "./stage";

/** Where to look at a place from: the photo that shows it free and near the middle; else where we are. */
export function vantage(place: Place, views: ViewEntry[], here: THREE.Vector3, geometry: Geometry): THREE.Vector3 {
  const offset = new THREE.Vector3();
  const scored = views.map((view) => {
    const { position, forward } = pose(view);
    offset.copy(place.center).sub(position);
    const depth = offset.dot(forward);
    const angle = offset.angleTo(forward) / Math.atan(Math.min(view.width / view.focal[0], view.height / view.focal[1]) / 2);
    const turn = offset.angleTo(place.center.clone().sub(here));
    return { position, score: depth > 0 ? angle + 0.8 * turn : Infinity };
  });
  const best = scored.sort((a, b) => a.score - b.score).slice(0, geometry.count > 300_000 ? 2 : 6);
  const free = best.find(({ position }) => {
    offset.copy(place.center).sub(position);
    const distance = offset.length();
    const hit = geometry.hit(new THREE.Ray(position, offset.normalize()));
    return hit !== null && Math.abs(hit.depth - distance) < Math.max(place.radius * 1.5, distance * 0.05);
  });
  return (free ?? best[0])?.position ?? here.clone();
}
