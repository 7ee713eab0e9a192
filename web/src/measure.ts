// The distance between two clicked points.

import * as THREE from "three";
import type { Geometry } from "./geometry";
import type { Manifest } from "./manifest";
import type { Overlay } from "./overlay";
import type { Stage } from "./stage";

export class Measure {
  active = false;
  points: THREE.Vector3[] = [];

  constructor(readonly stage: Stage, readonly geometry: Geometry, readonly overlay: Overlay, readonly manifest: Manifest) {}

  toggle(): boolean {
    this.active = !this.active;
    this.stage.canvas.classList.toggle("measuring", this.active);
    this.clear();
    return this.active;
  }

  clear(): void {
    this.points = [];
    this.overlay.show([]);
  }

  /** Take the surface at a point of the page; returns what to tell the visitor. */
  click(x: number, y: number): string {
    const hit = this.geometry.hit(this.stage.ray(x, y));
    if (!hit) return "Nothing to measure there: click on a surface.";
    this.points = this.points.length === 2 ? [hit.point] : [...this.points, hit.point];
    const [a, b] = this.points;
    const text = b ? this.length(a.distanceTo(b)) : "";
    this.overlay.show(this.points, text);
    this.stage.draw();
    return text ? `Distance: ${text}` : "Click on the second point.";
  }

  /** A length in meters where the scale is known, else in units of the scene. */
  length(units: number): string {
    const scale = this.manifest.scene.meters_per_unit;
    if (scale === null) return `${units.toPrecision(3)} units (the scale is not known)`;
    const meters = units * scale;
    return meters < 1 ? `${(meters * 100).toPrecision(3)} cm` : `${meters.toPrecision(3)} m`;
  }

  /** The sides of a box, as short as a list needs it. */
  sides(size: number[]): string {
    const scale = this.manifest.scene.meters_per_unit;
    if (scale === null) return `${size.map((side) => side.toPrecision(2)).join(" × ")} units`;
    const small = Math.max(...size) * scale < 1;
    return `${size.map((side) => (side * scale * (small ? 100 : 1)).toPrecision(2)).join(" × ")} ${small ? "cm" : "m"}`;
  }
}
