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
    const unknown = this.manifest.scene.meters_per_unit === null ? " (the scale is not known)" : "";
    return text ? `Distance: ${text}${unknown}` : "Click on the second point.";
  }

  /** A length in meters where the scale is known, else in units of the scene. */
  length(units: number): string {
    const scale = this.manifest.scene.meters_per_unit;
    if (scale === null) return `${units.toPrecision(3)} units`;
    const meters = units * scale;
    return meters < 1 ? `${(meters * 100).toPrecision(3)} cm` : `${meters.toPrecision(3)} m`;
  }

  /** The sides of a box with their unit. */
  sides(size: number[]): string {
    const { unit, sides } = this.sizes();
    return `${sides(size)} ${unit}`;
  }

  /** A unit for a list of boxes, and the sides of one in it. */
  sizes(): { unit: string; sides: (size: number[]) => string } {
    const scale = this.manifest.scene.meters_per_unit;
    const sides = (size: number[]): string => size.map((side) => short(side * (scale ?? 1))).join(" × ");
    return { unit: scale === null ? "units" : "m", sides };
  }
}

/** Two digits, also of numbers above a hundred, and two decimals at most. */
function short(value: number): string {
  return value >= 9.95 ? value.toFixed(0) : value.toFixed(value >= 0.995 ? 1 : 2);
}
