// Elements without HTML: what others wrote (titles, names, phrases) only ever becomes text.

type Child = Node | string | null | false;
type Properties = Record<string, string | number | boolean | ((event: never) => void) | undefined>;

/** An element. Properties that start with "on" are listeners, `text` is its text, all others are attributes. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K, properties: Properties = {}, ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === false) continue;
    if (typeof value === "function") element.addEventListener(name.slice(2), value as EventListener);
    else if (name === "text") element.textContent = String(value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children.filter((child): child is Node | string => child !== null && child !== false));
  return element;
}

const PATHS = {
  search: "M10.5 3a7.5 7.5 0 1 1 0 15a7.5 7.5 0 0 1 0-15M16 16l5 5",
  add: "M12 5v14M5 12h14",
  close: "M6 6l12 12M18 6L6 18",
  views: "M3 8h4l2-3h6l2 3h4v11H3zM12 10a3.5 3.5 0 1 0 0 7a3.5 3.5 0 0 0 0-7",
  measure: "M3 17L17 3l4 4L7 21zM7 13l2 2M10 10l3 3M13 7l2 2",
  heat: "M12 3c1 4 5 5 5 10a5 5 0 0 1-10 0c0-2 1-3 2-4c0 2 1 3 2 3c1-3-1-5 1-9",
  picture: "M4 4h16v16H4zM4 16l5-5l4 4l3-3l4 4M15.5 7.5v2M14.5 8.5h2",
  theme: "M12 3a9 9 0 1 0 0 18zM12 3a9 9 0 0 1 0 18",
  link: "M10 14a4 4 0 0 0 6 0l3-3a4 4 0 0 0-6-6l-1 1M14 10a4 4 0 0 0-6 0l-3 3a4 4 0 0 0 6 6l1-1",
  help: "M9 9a3 3 0 1 1 4 3c-1 .5-1 1-1 2M12 17.5v.5",
  before: "M15 5l-7 7l7 7",
  next: "M9 5l7 7l-7 7",
  shown: "M2 12s4-7 10-7s10 7 10 7s-4 7-10 7s-10-7-10-7M12 9a3 3 0 1 0 0 6a3 3 0 0 0 0-6",
  hidden: "M3 3l18 18M6 7c-2.500 1.800-4 5-4 5s4 7 10 7c2 0 3.700-.700 5-1.600M10 5.200c.600-.100 1.300-.200 2-.200c6 0 10 7 10 7s-.800 1.500-2.300 3.200",
  objects: "M4 6h2M9 6h11M4 12h2M9 12h11M4 18h2M9 18h11",
  video: "M3 6h12v12H3zM15 10.500l6-3.500v10l-6-3.500",
  colors: "M12 3a9 9 0 1 0 0 18c2 0 1-2 2-3s5 1 6-3a9 9 0 0 0-8-12M8 9v.5M13 7.500v.5M7 14v.5",
  undo: "M9 5L4 10l5 5M4 10h10a6 6 0 0 1 0 12h-3",
  redo: "M15 5l5 5l-5 5M20 10H10a6 6 0 0 0 0 12h3",
  whole: "M4 9V4h5M20 9V4h-5M4 15v5h5M20 15v5h-5",
};
export type Icon = keyof typeof PATHS;

export function icon(name: Icon): SVGSVGElement {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  path.setAttribute("d", PATHS[name]);
  svg.append(path);
  return svg;
}

/** A button with a picture; `label` is its name for screen readers and its tooltip. */
export function iconButton(name: Icon, label: string, onclick: () => void, key = ""): HTMLButtonElement {
  const title = key ? `${label} (${key})` : label;
  return h("button", { type: "button", class: "icon", "aria-label": label, title, onclick }, icon(name));
}

/** Whether fingers point: a focused text box brings up a keyboard that covers half of the page. */
export function isTouched(): boolean {
  return matchMedia("(pointer: coarse)").matches;
}

/** Close a panel after a choice where it covers what was chosen. */
export function closeOnPhone(panel: HTMLElement): void {
  if (!isTouched() && !matchMedia("(max-width: 640px), (max-height: 460px)").matches) return;
  panel.hidden = true;
  panel.dispatchEvent(new Event("close"));
}

/** Save a file from the page. */
export function save(blob: Blob, name: string): void {
  const url = URL.createObjectURL(blob);
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 1000);
}
