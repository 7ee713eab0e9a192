// What a link carries: prompts, view or camera, and how answers are shown.

import type { Mode } from "./painter";

/** Letters of what is asked, at most: lexsplat.viewer.history.MAX_LENGTH. */
export const MOST_LETTERS = 120;

export interface State {
  prompts: string[];
  view: string;
  /** Position, target and field of view of the camera; null where `view` says it. */
  camera: number[] | null;
  mode: Mode;
}

/** The state of a link such as `#q=red+mug&view=photo_3.jpg`; unknown and damaged parts are ignored. */
export function readState(hash: string): State {
  const parameters = new URLSearchParams(hash.replace(/^#/, ""));
  const camera = (parameters.get("camera") ?? "").split(",").map(Number);
  return {
    prompts: parameters.getAll("q").map((prompt) => prompt.slice(0, MOST_LETTERS)).filter((prompt) => prompt.trim()).slice(0, 6),
    view: parameters.get("view") ?? "",
    camera: camera.length === 7 && camera.every(Number.isFinite) ? camera : null,
    mode: parameters.get("show") === "heat" ? "heat" : "marks",
  };
}

export function writeState(state: State): string {
  const parameters = new URLSearchParams();
  for (const prompt of state.prompts) parameters.append("q", prompt);
  if (state.view) parameters.set("view", state.view);
  else if (state.camera) parameters.set("camera", state.camera.map((value) => Number(value.toPrecision(5))).join(","));
  if (state.mode === "heat") parameters.set("show", "heat");
  return `#${parameters.toString()}`;
}
