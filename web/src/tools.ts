// The tools at the side, and the keys that press them.

import type { App } from "./app";
import { h, iconButton, save } from "./dom";
import { PageError } from "./manifest";
import { helpDialog } from "./panels";
import { changeTheme } from "./theme";

/** The toolbar; its listeners end with `signal`. */
export function toolbar(app: App, signal: AbortSignal): HTMLElement {
  const press = (button: HTMLButtonElement, on: boolean): void => button.setAttribute("aria-pressed", String(on));
  const { manifest, server } = app;
  // Both lists stand in one place: opening one closes the other.
  const views = iconButton("views", "Where the photos were taken", () => {
    press(views, app.views.toggle());
    if (!app.views.element.hidden && !app.objects.element.hidden) press(objects, app.objects.toggle());
  }, "v");
  const objects = iconButton("objects", "Objects in this scene", () => {
    press(objects, app.objects.toggle());
    if (!app.objects.element.hidden && !app.views.element.hidden) press(views, app.views.toggle());
  }, "o");
  const measure = iconButton("measure", "Measure between two points", () => {
    press(measure, app.measure.toggle());
    app.note(app.measure.active ? "Click on two points." : "");
  }, "m");
  const heat = iconButton("heat", "Show heat instead of marks", () => press(heat, app.toggleHeat()), "h");
  app.onMode = (on) => press(heat, on);
  for (const [panel, button] of [[app.views, views], [app.objects, objects]] as const) {
    panel.element.addEventListener("close", () => press(button, false));
  }
  const dialog = helpDialog(manifest, server);
  const buttons: Record<string, HTMLButtonElement> = { v: views, o: objects, m: measure, h: heat };
  if (server) {
    const colors = iconButton("colors", "Language, codes, uncertainty", () => app.run(async () => press(colors, await app.nextColors())), "c");
    const { steps, undone } = server.entry;
    const undo = iconButton("undo", steps.length ? `Undo: ${steps.at(-1)!}` : "Nothing to undo", () => app.edits?.do("undo", {}), "z");
    const redo = iconButton("redo", undone ? "Redo" : "Nothing to redo", () => app.edits?.do("redo", {}), "y");
    undo.disabled = steps.length === 0;
    redo.disabled = undone === 0;
    press(colors, false);
    Object.assign(buttons, { c: colors, z: undo, y: redo });
  }
  Object.assign(buttons, {
    0: iconButton("whole", "Back to the start", () => app.start(null), "0"),
    p: iconButton("picture", "Save the picture", () => app.run(async () => save(await app.stage.picture(), "picture.png")), "p"),
    r: iconButton("video", "Record a video", () => app.run(() => saveVideo(app)), "r"),
    l: iconButton("link", "Copy the link", () => app.run(() => app.copyLink()), "l"),
    t: iconButton("theme", "Light or dark", () => (app.stage.background = changeTheme()), "t"),
    "?": iconButton("help", "Help and about", () => dialog.showModal(), "?"),
  });
  for (const button of [views, objects, measure, heat]) press(button, false);
  addEventListener("keydown", (event) => key(event, app, buttons), { signal });
  return h("nav", { class: "tools", "aria-label": "Tools" }, ...Object.values(buttons), dialog);
}

async function saveVideo(app: App): Promise<void> {
  app.note("Recording for six seconds …");
  const made = await app.stage.record();
  if (!made) throw new PageError("This browser records no videos.");
  save(made.video, `video${made.suffix}`);
  app.note("");
}

function key(event: KeyboardEvent, app: App, buttons: Record<string, HTMLButtonElement>): void {
  const { target } = event;
  const typing =
    target instanceof HTMLTextAreaElement || target instanceof HTMLSelectElement ||
    (target instanceof HTMLInputElement && !["range", "color", "checkbox"].includes(target.type));
  if (typing || app.edits?.busy || event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
  if (event.key === "/") {
    event.preventDefault();
    app.search.input.focus();
  } else if (event.key === "Escape") app.clear();
  else if (buttons[event.key]) buttons[event.key].click();
  else if (event.key === "[" || event.key === "]") app.views.step(event.key === "]" ? 1 : -1);
  else if (event.key === "Enter" && target === app.stage.canvas) app.pick(...app.stage.middle);
  else if ((target === app.stage.canvas || target === document.body) && app.stage.key(event.key, event.shiftKey)) {
    event.preventDefault();
  }
}
