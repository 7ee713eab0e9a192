// Marks on the picture: the points of a measurement and what was clicked.

import * as THREE from "three";
import { h } from "./dom";
import type { Stage } from "./stage";

/** Pixels from the upper point to the middle of the text: it hides neither point nor the line. */
const ABOVE = 26;

export class Overlay {
  readonly element = h("div", { class: "overlay", "aria-hidden": "true" });
  readonly #svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  readonly #line = document.createElementNS("http://www.w3.org/2000/svg", "line");
  readonly #marks: { point: THREE.Vector3; mark: HTMLElement }[] = [];
  readonly #label = h("span", { class: "distance" });

  constructor(readonly stage: Stage) {
    this.#svg.append(this.#line);
    this.element.append(this.#svg, this.#label);
  }

  /** Show points and, between two of them, a line with a text. */
  show(points: THREE.Vector3[], text = ""): void {
    for (const { mark } of this.#marks) mark.remove();
    this.#marks.length = 0;
    for (const point of points) {
      const mark = h("span", { class: "mark" });
      this.element.append(mark);
      this.#marks.push({ point, mark });
    }
    this.#label.textContent = text;
    this.update();
  }

  /** Follow the camera. */
  update(): void {
    const places = this.#marks.map(({ point }) => this.stage.pixel(point));
    this.#marks.forEach(({ mark }, n) => move(mark, places[n]));
    const [a, b] = places;
    const drawn = Boolean(a && b && this.#label.textContent);
    this.#svg.style.display = drawn ? "" : "none";
    this.#label.style.display = drawn ? "" : "none";
    if (!a || !b) return;
    for (const [name, value] of Object.entries({ x1: a.x, y1: a.y, x2: b.x, y2: b.y })) {
      this.#line.setAttribute(name, value.toFixed(1));
    }
    move(this.#label, { x: (a.x + b.x) / 2, y: Math.min(a.y, b.y) - ABOVE });
  }
}

function move(element: HTMLElement, place: { x: number; y: number } | null): void {
  element.style.display = place ? "" : "none";
  if (place) element.style.transform = `translate(${place.x.toFixed(1)}px, ${place.y.toFixed(1)}px) translate(-50%, -50%)`;
}
