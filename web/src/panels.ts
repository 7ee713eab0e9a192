// Panels that open: the original views, and help.

import { h, iconButton } from "./dom";
import type { Manifest, ViewEntry } from "./manifest";

export function viewsPanel(views: ViewEntry[], jump: (view: ViewEntry) => void) {
  let current = -1;
  const buttons = views.map((view, n) => h("button", { type: "button", text: view.name, onclick: () => go(n) }));
  const list = h("ul", {}, ...buttons.map((button) => h("li", {}, button)));
  const go = (n: number): void => {
    if (views.length === 0) return;
    current = (n + views.length) % views.length;
    jump(views[current]);
  };
  const step = (by: number): void => go(current < 0 ? (by > 0 ? 0 : -1) : current + by);
  const element = h(
    "aside",
    { class: "views", "aria-label": "Where the photos were taken", hidden: true },
    h(
      "div",
      { class: "row" },
      h("strong", { text: `${views.length} photos` }),
      iconButton("before", "Previous photo", () => step(-1), "["),
      iconButton("next", "Next photo", () => step(1), "]"),
    ),
    list,
  );
  return {
    element,
    step,
    toggle(): boolean {
      element.hidden = !element.hidden;
      return !element.hidden;
    },
    mark(name: string): void {
      current = name ? views.findIndex((view) => view.name === name) : -1;
      buttons.forEach((button, n) => button.setAttribute("aria-current", String(n === current)));
      buttons[current]?.scrollIntoView({ block: "nearest" });
    },
  };
}

const KEYS: [string, string][] = [
  ["/", "search"],
  ["Enter, Shift+Enter", "ask, add to the answers"],
  ["Escape", "remove all answers"],
  ["arrows, + and -", "turn and approach (with Shift: move)"],
  ["[ and ]", "previous and next photo"],
  ["v, m, h", "photos, measure, heat"],
  ["0, p, l, t", "start, save the picture, copy the link, light or dark"],
];

export function helpDialog(manifest: Manifest): HTMLDialogElement {
  const { scene, words, text, lexsplat, licenses } = manifest;
  const shown = scene.gaussians.toLocaleString("en") + (scene.of > scene.gaussians ? ` of ${scene.of.toLocaleString("en")}` : "");
  const dialog = h("dialog", { "aria-label": "Help and about" });
  dialog.append(
    h("h2", { text: "Search this place with words" }),
    h("p", { text: "Type what you look for. Commas ask for several things, each in its color. Click on anything to hear what it may be." }),
    h("dl", {}, ...KEYS.flatMap(([keys, what]) => [h("dt", { text: keys }), h("dd", { text: what })])),
    h("p", {
      class: "fine",
      text:
        `${shown} Gaussians. ${words.count.toLocaleString("en")} phrases are answered from tables` +
        (text ? ", all others by a text model in this page." : "; this page has no text model for others.") +
        " Nothing you type leaves this page.",
    }),
    h("p", { class: "fine", text: `Made with lexsplat ${lexsplat}. ${Object.entries(licenses).map(([name, license]) => `${name}: ${license}`).join("; ")}.` }),
    h("button", { type: "button", text: "Close", onclick: () => dialog.close() }),
  );
  return dialog;
}
