// Edits of the scene, one at a time: told at once, and nothing else can be asked until they are done.

import type { Change } from "./painter";
import type { Server } from "./server";

/** What an edit is called while it is done, and afterwards. */
const DOING = {
  delete: "Deleting", keep: "Removing all else", recolor: "Recoloring", move: "Moving", duplicate: "Duplicating",
  undo: "Undoing", redo: "Redoing",
} as const;
const DONE: Record<keyof typeof DOING, string> = {
  delete: "deleted", keep: "all else removed", recolor: "recolored", move: "moved", duplicate: "duplicated",
  undo: "undone", redo: "redone",
};

export type Edit = Change | "undo" | "redo";

export class Edits {
  // Of the whole page: the scene that an edit makes gets controls of its own, which wait until it is shown.
  static #busy = false;
  static #controls: HTMLElement[] = [];

  /** `controls` wait while an edit is done; `run` tells what fails. */
  constructor(
    readonly server: Server,
    controls: HTMLElement[],
    readonly note: (text: string) => void,
    readonly run: (work: () => Promise<void>) => void,
  ) {
    Edits.#controls = controls;
    this.#wait(Edits.#busy);
  }

  get busy(): boolean {
    return Edits.#busy;
  }

  do(action: Edit, values: object): void {
    if (this.busy) return;
    const begun = performance.now();
    this.note(`${DOING[action]} …`);
    this.#wait(true);
    this.run(async () => {
      try {
        await this.server.edit(action, values);
      } finally {
        this.#wait(false);
      }
      const seconds = ((performance.now() - begun) / 1000).toFixed(1);
      window.lexsplat.app?.note(`Done: ${DONE[action]} (${seconds} s).`); // another page of the scene by now
    });
  }

  #wait(busy: boolean): void {
    Edits.#busy = busy;
    for (const element of Edits.#controls) element.inert = busy;
  }
}
