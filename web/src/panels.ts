// Panels that open: the original views, and help.

import { leftOut } from "./budget";
import { closeOnPhone, h, iconButton } from "./dom";
import type { Manifest, ObjectEntry, ViewEntry } from "./manifest";
import type { Server } from "./server";

/** The list of the original views; with `photos`, the photo of the current one beside the picture. */
export function viewsPanel(views: ViewEntry[], jump: (view: ViewEntry) => void, photos: boolean) {
  let current = -1;
  const image = h("img", { alt: "", onerror: () => caption("The photo is not where the scene was built from."), onload: () => caption("") });
  const figure = h("figure", { class: "photo", hidden: true }, image, h("figcaption"));
  const caption = (text: string): void => {
    figure.lastElementChild!.textContent = text || (views[current]?.name ?? "");
  };
  const look = (): void => {
    figure.hidden = !beside?.checked || current < 0;
    if (figure.hidden) return;
    image.alt = `The photo ${views[current].name}`;
    image.src = `photo/${current}`;
  };
  const beside = photos ? h("input", { type: "checkbox", onchange: () => look() }) : null;
  const choose = (n: number): void => {
    go(n);
    closeOnPhone(element);
  };
  const buttons = views.map((view, n) => h("button", { type: "button", text: view.name, onclick: () => choose(n) }));
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
    beside && h("label", { class: "row fine" }, beside, "Show the photo beside the picture"),
    list,
  );
  return {
    element,
    figure,
    step,
    toggle(): boolean {
      element.hidden = !element.hidden;
      return !element.hidden;
    },
    mark(name: string): void {
      current = name ? views.findIndex((view) => view.name === name) : -1;
      buttons.forEach((button, n) => button.setAttribute("aria-current", String(n === current)));
      buttons[current]?.scrollIntoView({ block: "nearest" });
      look();
    },
  };
}

/** The list of objects: name and size, found when it is first opened. */
export function objectsPanel(
  find: () => Promise<ObjectEntry[]>, { unit, sides }: { unit: string; sides: (size: number[]) => string }, go: (object: ObjectEntry) => void,
) {
  const list = h("ul", {});
  const head = h("strong", { text: "Objects" });
  const kind = h("span", { class: "fine", text: `sizes in ${unit}` });
  const element = h("aside", { class: "views objects", "aria-label": "Objects in this scene", hidden: true }, h("div", { class: "row" }, head, kind), list);
  let found: Promise<void> | null = null;
  const choose = (object: ObjectEntry): void => {
    go(object);
    closeOnPhone(element);
  };
  const fill = async (): Promise<void> => {
    head.textContent = "Looking for objects …";
    const objects = await find();
    head.textContent = objects.length === 1 ? "One object" : `${objects.length} objects`;
    list.replaceChildren(
      ...objects.map((object) =>
        h("li", {}, h("button", { type: "button", onclick: () => choose(object) }, h("span", { text: object.name }), h("span", { class: "fine", text: sides(object.size) }))),
      ),
    );
  };
  return {
    element,
    toggle(): boolean {
      element.hidden = !element.hidden;
      if (!element.hidden) found ??= fill().catch((error: unknown) => void (head.textContent = String(error)));
      return !element.hidden;
    },
  };
}

const KEYS: [string, string][] = [
  ["/", "search"],
  ["Enter, Shift+Enter", "ask, add to the answers"],
  ["Escape", "remove all answers"],
  ["Enter on the picture", "what is in its middle? While measuring: take that point"],
  ["arrows, + and -", "turn and approach (with Shift: move)"],
  ["[ and ]", "previous and next photo"],
  ["v, o, m, h", "photos, objects, measure, heat"],
  ["0, p, r, l, t", "start, save the picture, record a video, copy the link, light or dark"],
];

export function helpDialog(manifest: Manifest, server: Server | null): HTMLDialogElement {
  const { scene, words, text, lexsplat, licenses } = manifest;
  const shown = `${scene.gaussians.toLocaleString("en")} Gaussians. ${leftOut(scene)}`;
  const answering =
    `${words.count.toLocaleString("en")} phrases are answered from tables` +
    (text ? ", all others by a text model in this page." : "; this page has no text model for others.") +
    " Nothing you type leaves this page.";
  const keys: typeof KEYS = server ? [...KEYS, ["c, z, y", "other colors, undo, redo"]] : KEYS;
  const dialog = h("dialog", { "aria-label": "Help and about" });
  dialog.append(
    h("h2", { text: "Search this place with words" }),
    h("p", { text: "Type what you look for. Commas ask for several things, each in its color. Click on anything to hear what it may be." }),
    h("dl", {}, ...keys.flatMap(([keys, what]) => [h("dt", { text: keys }), h("dd", { text: what })])),
    h("p", { class: "fine", text: `${shown} ${server ? "The server of lexsplat view answers." : answering}` }),
    server ? names(server) : "",
    h("p", { class: "fine", text: `Made with lexsplat ${lexsplat}. ${Object.entries(licenses).map(([name, license]) => `${name}: ${license}`).join("; ")}.` }),
    h("button", { type: "button", text: "Close", onclick: () => dialog.close() }),
  );
  return dialog;
}

/** The names that clicks choose from. */
function names(server: Server): HTMLElement {
  const area = h("textarea", { rows: 3, "aria-label": "Names that a click chooses from" });
  area.value = server.entry.vocabulary.join(", ");
  const use = async (): Promise<void> => {
    area.value = (await server.setVocabulary(area.value.split(/[,\n]/))).join(", ");
  };
  return h(
    "details",
    {},
    h("summary", { text: "Names that a click chooses from" }),
    area,
    h("button", { type: "button", text: "Use these names", onclick: () => void use().catch((error: unknown) => (area.value = String(error))) }),
  );
}

/** Title and description of the scene, and what is not drawn. */
export function titleOf({ title, description, scene }: Manifest): HTMLElement {
  const lines = [description, leftOut(scene)].filter(Boolean).map((text) => h("p", { text }));
  return h("div", { class: "title" }, h("h1", { text: title }), ...lines);
}
