// What a server can do with an answer: facts, files, and edits that are shown before they are done.

import * as THREE from "three";
import { type Answer } from "./answers";
import { h, save } from "./dom";
import type { Geometry } from "./geometry";
import { type Change, CHANGES, type Preview } from "./painter";
import type { Server } from "./server";

export interface BenchHost {
  preview(preview: Preview | null): void;
  jump(view: string): void;
  edit(action: Change, values: object): void;
  /** Run something that may fail with a line for the visitor. */
  run(work: () => Promise<void>): void;
}

const LABELS: Record<Change, string> = {
  delete: "Delete it", keep: "Keep only it", recolor: "Recolor", move: "Move", duplicate: "Duplicate",
};

/** The part of a card that opens: size, photos, download, edit. */
export function workbench(answer: Answer, server: Server, geometry: Geometry, up: THREE.Vector3, host: BenchHost): HTMLElement {
  const facts = h("p", { class: "fine" });
  const middle = answer.places?.[answer.place]?.center.clone() ?? new THREE.Vector3();
  const photos = h("p", { class: "examples" });
  const several = answer.places && answer.places.length > 1 ? answer.places.length : 0;
  const all = h("input", { type: "checkbox", onchange: () => element.dispatchEvent(new Event("toggle")) });
  const instance = (): number | null => (several && !all.checked ? answer.place : null);
  const formats = h("select", { "aria-label": "File format" }, ...server.entry.formats.map((name) => h("option", { value: name, text: name })));
  const download = h("button", {
    type: "button",
    text: "Download",
    onclick: () =>
      host.run(async () => {
        const { name, file } = await server.download(answer, instance(), formats.value);
        save(file, name);
      }),
  });
  const element = h(
    "details",
    {
      class: "bench",
      ontoggle: () => {
        if (!element.open) return host.preview(null);
        host.run(async () => {
          const found = await server.details(answer, instance());
          middle.fromArray(found.center); // about which the server turns and scales
          const lengths = (found.size_meters ?? found.size).map((value) => value.toPrecision(3)).join(" × ");
          const unit = found.size_meters ? "m" : "units";
          const at = found.center.map((value) => value.toFixed(2)).join(", ");
          facts.textContent = `${lengths} ${unit} at ${at}; ${found.gaussians.toLocaleString("en")} Gaussians`;
          photos.replaceChildren("Seen best in: ", ...found.views.map(({ name }) => h("button", { type: "button", text: name, onclick: () => host.jump(name) })));
        });
      },
    },
    h("summary", { text: "Size, file, edit" }),
    facts,
    photos,
    several > 0 && h("label", { class: "scope" }, all, ` All ${several} places, not only this one`),
    h("div", { class: "row" }, formats, download),
    editor(answer, server, geometry, { up, middle }, host, { instance, all }),
  );
  return element;
}

function editor(
  answer: Answer, server: Server, geometry: Geometry, axes: { up: THREE.Vector3; middle: THREE.Vector3 }, host: BenchHost,
  { instance, all }: { instance: () => number | null; all: HTMLInputElement },
): HTMLElement {
  const input = (label: string, value: string, step = "any"): HTMLInputElement =>
    h("input", { type: "number", value, step, "aria-label": label, title: label, oninput: () => show() });
  const color = h("input", { type: "color", value: "#2f6fdf", "aria-label": "New color", oninput: () => show() });
  const by = ["x", "y", "z"].map((axis) => input(`Shift along ${axis}, units of the scene`, "0", "0.05"));
  const turn = input("Turn, degrees", "0", "5");
  const scale = input("Size, factor", "1");
  scale.min = "0.001";
  const moving = h("div", { class: "row numbers", hidden: true }, "by", ...by, "turn", turn, "×", scale);
  const change = h(
    "select",
    { "aria-label": `Edit ${answer.prompt}`, onchange: () => show() },
    h("option", { value: "", text: "Edit …" }),
    ...CHANGES.map((name) => h("option", { value: name, text: LABELS[name] })),
  );
  const apply = h("button", { type: "button", text: "Apply", onclick: () => (scale.checkValidity() ? host.edit(change.value as Change, values()) : scale.reportValidity()) });
  const taken = h("p", { class: "fine taken", "aria-live": "polite" });
  /** What the last change that was chosen would apply to. */
  let planned: { kind: Change; of: number | null; splats: number[]; light: number } | null = null;
  const amount = (field: HTMLInputElement, least = -Infinity): number => {
    const value = Number(field.value);
    return Number.isFinite(value) && value > least ? value : Number(field.defaultValue);
  };
  const values = () => ({
    ...answer.asked,
    instance: instance(),
    color: [1, 3, 5].map((at) => parseInt(color.value.slice(at, at + 2), 16) / 255),
    by: by.map((field) => amount(field)),
    turn: amount(turn),
    scale: amount(scale, 0),
  });
  const show = (): void => {
    const kind = change.value as Change | "";
    moving.hidden = kind !== "move" && kind !== "duplicate";
    color.hidden = kind !== "recolor";
    apply.hidden = kind === "";
    taken.hidden = kind === "";
    if (kind === "") return host.preview(null);
    if (planned?.kind !== kind || planned.of !== instance()) {
      taken.textContent = "Looking for what it takes along …";
      return host.run(async () => {
        const of = instance();
        const { splats, count } = await server.preview(kind, { ...answer.asked, instance: of });
        planned = { kind, of, splats, light: geometry.light(splats) };
        taken.textContent = told(kind, count);
        if (change.value === kind && instance() === of) show();
      });
    }
    host.preview({
      change: kind,
      splats: planned.splats,
      color: color.value,
      light: planned.light,
      by: new THREE.Vector3(...by.map((field) => amount(field))),
      pivot: axes.middle,
      turn: new THREE.Quaternion().setFromAxisAngle(axes.up, THREE.MathUtils.degToRad(amount(turn))),
      scale: amount(scale, 0),
    });
  };
  color.hidden = apply.hidden = true;
  all.addEventListener("change", show);
  return h("div", {}, h("div", { class: "row" }, change, color, apply), moving, taken);
}

/** What an edit applies to, in words; hidden parts count too. */
function told(kind: Change, count: number): string {
  const hole = kind === "delete" ? " When you apply, what no photo shows under it goes too, and the surface there is closed." : "";
  return `${count.toLocaleString("en")} Gaussians with the hidden ones inside it.${hole}`;
}
