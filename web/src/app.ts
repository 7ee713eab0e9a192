// The page: one picture, one search bar, and what was found.

import * as THREE from "three";
import { type Answer, Answerer, card, freeColor, painted, placesOf, spoken } from "./answers";
import { Dictionary } from "./dictionary";
import { h, icon, iconButton, save } from "./dom";
import { Geometry, type Place } from "./geometry";
import { Language, shownSplats } from "./language";
import type { Manifest, ViewEntry } from "./manifest";
import { Overlay } from "./overlay";
import { MOST_PROMPTS, type Mode, Painter } from "./painter";
import { SearchBar } from "./search";
import { type Stage, pose } from "./stage";
import { readState, writeState } from "./state";
import { helpDialog, viewsPanel } from "./panels";
import type { TowerLoader } from "./tower-loader";

export interface Content {
  codes: Uint8Array;
  phrases: string;
  table: Uint8Array;
}

/** In larger scenes, colors appear before the places are found. */
const MOST_AT_ONCE = 200_000;

export class App {
  readonly answers: Answer[] = [];
  readonly answerer: Answerer;
  readonly language: Language;
  readonly geometry: Geometry;
  readonly #painter: Painter;
  readonly #overlay: Overlay;
  readonly #search: SearchBar;
  readonly #list = h("ul", { class: "answers", "aria-label": "Answers" });
  readonly #sheet: HTMLElement;
  readonly #status = h("div", { class: "status", role: "status", "aria-live": "polite" });
  readonly #views: ReturnType<typeof viewsPanel>;
  readonly #bounds: { center: THREE.Vector3; radius: number };
  #mode: Mode = "marks";
  #view = "";
  #measuring = false;
  #points: THREE.Vector3[] = [];
  #written = "";

  constructor(
    readonly stage: Stage,
    readonly manifest: Manifest,
    content: Content,
    readonly loader: TowerLoader | null,
    root: HTMLElement,
  ) {
    const numCodes = manifest.language.num_codes;
    this.language = new Language(content.codes, numCodes);
    this.geometry = new Geometry(stage.mesh, this.language.count);
    this.#painter = new Painter(stage.mesh, this.language);
    this.#bounds = this.geometry.bounds();
    const shown = shownSplats(this.geometry.opacities);
    const dictionary = new Dictionary(content.phrases, content.table, numCodes);
    dictionary.rank(this.language, shown);
    const tower = loader ? async (phrase: string) => (await loader.load())?.describe(phrase) ?? null : null;
    this.answerer = new Answerer(dictionary, this.language, shown, tower);

    const examples = dictionary.examples(4);
    this.#search = new SearchBar(
      { complete: (text) => dictionary.complete(text), ask: (text, add) => void this.ask(text, add) },
      examples[0] ?? "",
    );
    this.#views = viewsPanel(manifest.views, (view) => this.jump(view));
    this.#overlay = new Overlay(stage);
    const head = h("div", { class: "title" }, h("h1", { text: manifest.title }), manifest.description && h("p", { text: manifest.description }));
    const tries = h("p", { class: "examples" }, examples.length > 0 && "Try: ");
    for (const phrase of examples) {
      tries.append(h("button", { type: "button", text: phrase, onclick: () => void this.ask(phrase, false) }));
    }
    this.#sheet = h("section", { class: "sheet", "aria-label": "What was found" }, tries, this.#list, this.#status);
    root.append(
      h("div", { class: "bar" }, this.#search.element, this.#sheet),
      head,
      this.#tools(),
      this.#views.element,
      this.#overlay.element,
    );
    stage.onMove = () => this.#moved();
    stage.onDraw = () => this.#overlay.update();
    this.#listen();
    new ResizeObserver(() => this.#cover()).observe(this.#sheet);
  }

  /** Take up the state of the link; true if it says where to stand. */
  async restore(): Promise<void> {
    const state = readState(location.hash);
    const view = this.manifest.views.find(({ name }) => name === state.view) ?? null;
    if (state.camera) {
      const [x, y, z, a, b, c, fov] = state.camera;
      const placed = new THREE.Vector3(x, y, z);
      await this.stage.fly(placed, new THREE.Vector3(a, b, c), false, THREE.MathUtils.clamp(fov, 5, 120));
    } else this.#start(view);
    this.#mode = state.mode;
    const given = state.prompts.map((prompt) => prompt.toLowerCase());
    if (given.join("\n") === this.answers.map((answer) => answer.prompt.toLowerCase()).join("\n")) return;
    this.clear();
    for (const prompt of state.prompts) await this.ask(prompt, true, !view && !state.camera);
  }

  /** Ask for something; several prompts are separated by commas. */
  async ask(text: string, add = false, fly = true): Promise<void> {
    const prompts = text.split(",").map((part) => part.trim()).filter(Boolean);
    if (!add) this.answers.length = 0;
    this.#note("");
    for (const prompt of prompts) {
      if (this.answers.length === MOST_PROMPTS) this.answers.shift();
      const answer = await this.answerer.answer(prompt, freeColor(this.answers));
      if (!answer) {
        this.#unknown(prompt);
        continue;
      }
      this.answers.push(answer);
    }
    if (this.geometry.count > MOST_AT_ONCE) {
      this.#paint(); // colors first, then places
      await new Promise((resolve) => setTimeout(resolve));
    }
    for (const answer of this.answers) placesOf(answer, this.geometry);
    this.#paint();
    this.#refresh();
    const latest = this.answers.at(-1);
    if (latest) this.#say(this.answers.slice(-prompts.length).map((answer) => `${answer.prompt}: ${spoken(answer)}`).join(". "));
    if (fly && latest?.places?.length) this.#flyTo(latest);
  }

  clear(): void {
    this.answers.length = 0;
    this.#note("");
    this.#points = [];
    this.#overlay.show([]);
    this.#paint();
    this.#refresh();
  }

  /** Stand where a photo was taken. */
  jump(view: ViewEntry, fly = true): void {
    const { position, forward } = pose(view);
    const depth = Math.max(this.#bounds.center.clone().sub(position).dot(forward), this.#bounds.radius * 0.2);
    this.#view = "";
    this.stage.jump(view, depth, fly);
    this.#view = view.name;
    this.#views.mark(view.name);
    this.#write();
  }

  #start(view: ViewEntry | null): void {
    const { views, scene } = this.manifest;
    const chosen = view ?? views.find(({ name }) => name === scene.start_view) ?? views[0];
    const { center, radius } = this.#bounds;
    this.stage.camera.near = radius / 500;
    this.stage.camera.far = radius * 200;
    if (chosen) return this.jump(chosen, false);
    const back = new THREE.Vector3(1, 0.6, 0.5).normalize().multiplyScalar(radius * 2.5);
    void this.stage.fly(center.clone().add(back), center, false);
  }

  #flyTo(answer: Answer): void {
    const place = answer.places?.[answer.place];
    if (place) this.stage.flyTo(place, this.#vantage(place));
  }

  /** Where to look at a place from: the photo that shows it free and near the middle; else where we are. */
  #vantage(place: Place): THREE.Vector3 {
    const offset = new THREE.Vector3();
    const scored = this.manifest.views.map((view) => {
      const { position, forward } = pose(view);
      offset.copy(place.center).sub(position);
      const depth = offset.dot(forward);
      const angle = offset.angleTo(forward) / Math.atan(Math.min(view.width / view.focal[0], view.height / view.focal[1]) / 2);
      const turn = offset.angleTo(place.center.clone().sub(this.stage.camera.position));
      return { position, score: depth > 0 ? angle + 0.8 * turn : Infinity };
    });
    const best = scored.sort((a, b) => a.score - b.score).slice(0, this.geometry.count > 300_000 ? 2 : 6);
    const free = best.find(({ position }) => {
      offset.copy(place.center).sub(position);
      const distance = offset.length();
      const hit = this.geometry.hit(new THREE.Ray(position, offset.normalize()));
      return hit !== null && Math.abs(hit.depth - distance) < Math.max(place.radius * 1.5, distance * 0.05);
    });
    return (free ?? best[0])?.position ?? this.stage.camera.position.clone();
  }

  #paint(): void {
    const shown = this.answers.filter(painted);
    this.#painter.paint(shown.map((answer) => ({ ...answer, splats: answer.places?.flatMap((place) => place.splats) ?? null })), this.#mode);
    this.stage.draw();
    this.#write();
  }

  #refresh(): void {
    this.#list.replaceChildren(
      ...this.answers.map((answer) =>
        card(answer, {
          show: (one, step) => {
            const count = one.places?.length ?? 0;
            one.place = count ? (one.place + step) % count : 0;
            this.#refresh();
            this.#flyTo(one);
          },
          remove: (one) => {
            this.answers.splice(this.answers.indexOf(one), 1);
            this.#paint();
            this.#refresh();
            this.#search.input.focus();
          },
          changed: (one) => {
            one.place = 0;
            this.#paint();
            clearTimeout(this.#later);
            this.#later = setTimeout(() => {
              placesOf(one, this.geometry);
              this.#paint();
              const focused = document.activeElement?.getAttribute("aria-label");
              this.#refresh();
              if (focused) this.#list.querySelector<HTMLElement>(`[aria-label="${CSS.escape(focused)}"]`)?.focus();
            }, 250);
          },
        }),
      ),
    );
    this.#sheet.classList.toggle("asked", this.answers.length > 0);
  }
  #later: ReturnType<typeof setTimeout> | undefined;

  /** Nothing in the page can tell what a prompt means: offer the nearest phrases. */
  #unknown(prompt: string): void {
    const near = this.answerer.dictionary.similar(prompt);
    const count = this.answerer.dictionary.phrases.length.toLocaleString("en");
    this.#note(`“${prompt}” is not among the ${count} phrases of this page.`, near);
    if (this.loader?.waiting) {
      const size = (this.loader.bytes / 1e6).toFixed(0);
      this.#status.append(
        h("button", {
          type: "button",
          text: `Load the text model (${size} MB) to ask anything`,
          onclick: () => void this.loader?.agree().then(() => this.ask(prompt, true)),
        }),
      );
    }
  }

  #note(text: string, near: string[] = []): void {
    this.#status.replaceChildren(text ? h("p", { text }) : "");
    if (near.length) {
      this.#status.append(h("p", { class: "examples" }, "Nearest: ", ...near.map((phrase) => h("button", { type: "button", text: phrase, onclick: () => void this.ask(phrase, true) }))));
    }
    this.#sheet.classList.toggle("noted", Boolean(text));
  }

  #say(text: string): void {
    if (this.#status.childElementCount === 0 || this.#status.firstElementChild?.className === "spoken") {
      this.#status.replaceChildren(h("p", { class: "spoken", text }));
    }
  }

  /** What is under a point of the page: names from the dictionary, the likeliest first. */
  whatIs(x: number, y: number): { phrase: string; score: number }[] | null {
    const hit = this.geometry.hit(this.stage.ray(x, y));
    if (!hit) return null;
    const names = this.answerer.dictionary.name(this.language.distribution(hit.splats, hit.shares), 4);
    this.#points = [];
    this.#overlay.show([hit.point]);
    const sure = names.filter(({ score }) => score >= 0.5);
    const shown = sure.length ? sure : names.slice(0, 2);
    const position = hit.point.toArray().map((value) => value.toFixed(2)).join(", ");
    this.#note(sure.length ? "This may be:" : "No phrase of this page fits well. Nearest:");
    this.#status.append(
      h("p", { class: "examples" }, ...shown.map(({ phrase, score }) =>
        h("button", { type: "button", text: phrase, title: `relevancy ${score.toFixed(2)}`, onclick: () => void this.ask(phrase, false) }))),
      h("p", { class: "fine", text: `at ${position}` }),
    );
    return names;
  }

  #measure(x: number, y: number): void {
    const hit = this.geometry.hit(this.stage.ray(x, y));
    if (!hit) return this.#note("Nothing to measure there: click on a surface.");
    this.#points = this.#points.length === 2 ? [hit.point] : [...this.#points, hit.point];
    const [a, b] = this.#points;
    const text = b ? this.#length(a.distanceTo(b)) : "";
    this.#overlay.show(this.#points, text);
    this.#note(text ? `Distance: ${text}` : "Click on the second point.");
    this.stage.draw();
  }

  /** A length in meters where the scale is known, else in units of the scene. */
  #length(units: number): string {
    const scale = this.manifest.scene.meters_per_unit;
    if (scale === null) return `${units.toPrecision(3)} units (the scale is not known)`;
    const meters = units * scale;
    return meters < 1 ? `${(meters * 100).toPrecision(3)} cm` : `${meters.toPrecision(3)} m`;
  }

  #tools(): HTMLElement {
    const toggle = (button: HTMLButtonElement, on: boolean): void => button.setAttribute("aria-pressed", String(on));
    const views = iconButton("views", "Where the photos were taken", () => toggle(views, this.#views.toggle()), "v");
    const measure = iconButton("measure", "Measure between two points", () => {
      this.#measuring = !this.#measuring;
      toggle(measure, this.#measuring);
      this.#points = [];
      this.#overlay.show([]);
      this.stage.canvas.classList.toggle("measuring", this.#measuring);
      this.#note(this.#measuring ? "Click on two points." : "");
    }, "m");
    const heat = iconButton("heat", "Show heat instead of marks", () => {
      this.#mode = this.#mode === "heat" ? "marks" : "heat";
      toggle(heat, this.#mode === "heat");
      this.#paint();
    }, "h");
    const dialog = helpDialog(this.manifest);
    const help = iconButton("help", "Help and about", () => dialog.showModal(), "?");
    const buttons = {
      v: views,
      m: measure,
      h: heat,
      0: iconButton("whole", "Back to the start", () => this.#start(null), "0"),
      p: iconButton("picture", "Save the picture", () => void this.#save(), "p"),
      l: iconButton("link", "Copy the link", () => void this.#copy(), "l"),
      t: iconButton("theme", "Light or dark", () => this.theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"), "t"),
      "?": help,
    };
    for (const button of [views, measure, heat]) toggle(button, false);
    addEventListener("keydown", (event) => this.#key(event, buttons));
    return h("nav", { class: "tools", "aria-label": "Tools" }, ...Object.values(buttons), dialog);
  }

  #key(event: KeyboardEvent, buttons: Record<string, HTMLButtonElement>): void {
    const typing = event.target instanceof HTMLInputElement && event.target.type === "text";
    if (typing || event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (event.key === "/") {
      event.preventDefault();
      this.#search.input.focus();
    } else if (event.key === "Escape") this.clear();
    else if (buttons[event.key]) buttons[event.key].click();
    else if (event.key === "[" || event.key === "]") this.#views.step(event.key === "]" ? 1 : -1);
    else if (event.target === this.stage.canvas || event.target === document.body) {
      if (this.stage.key(event.key, event.shiftKey)) event.preventDefault();
    }
  }

  #listen(): void {
    const { canvas } = this.stage;
    let down: { x: number; y: number; time: number } | null = null;
    canvas.addEventListener("pointerdown", (event) => {
      down = event.isPrimary && event.button === 0 ? { x: event.clientX, y: event.clientY, time: event.timeStamp } : null;
    });
    canvas.addEventListener("pointerup", (event) => {
      if (!down || Math.hypot(event.clientX - down.x, event.clientY - down.y) > 6 || event.timeStamp - down.time > 600) return;
      down = null;
      if (this.#measuring) this.#measure(event.clientX, event.clientY);
      else if (!this.whatIs(event.clientX, event.clientY)) this.#note("Nothing is there.");
      this.stage.draw();
    });
    addEventListener("hashchange", () => location.hash !== this.#written && void this.restore());
  }

  theme(name: string): void {
    document.documentElement.dataset.theme = name;
    this.stage.background = getComputedStyle(document.documentElement).getPropertyValue("--ground").trim();
    try {
      localStorage.setItem("lexsplat-theme", name);
    } catch {
      // a page from a file may not store anything
    }
  }

  async #save(): Promise<void> {
    save(await this.stage.picture(), "picture.png");
  }

  async #copy(): Promise<void> {
    this.#write();
    try {
      await navigator.clipboard.writeText(location.href);
      this.#note("The link is copied. It carries the prompts and the view.");
    } catch {
      this.#note(`Copy the address of this page: ${location.href}`);
    }
  }

  #moved(): void {
    if (this.#view) {
      const view = this.manifest.views.find(({ name }) => name === this.#view);
      if (view && pose(view).position.distanceTo(this.stage.camera.position) > this.#bounds.radius * 1e-3) {
        this.#view = "";
        this.#views.mark("");
      }
    }
    this.#write();
  }

  /** Write the state into the link, at most four times a second. */
  #write(): void {
    clearTimeout(this.#writing);
    this.#writing = setTimeout(() => {
      const { camera, target } = this.stage;
      this.#written = writeState({
        prompts: this.answers.map((answer) => answer.prompt),
        view: this.#view,
        camera: [...camera.position.toArray(), ...target.toArray(), camera.fov],
        mode: this.#mode,
      });
      try {
        history.replaceState(null, "", this.#written);
      } catch {
        // a page without an address of its own
      }
    }, 250);
  }
  #writing: ReturnType<typeof setTimeout> | undefined;

  /** On phones the sheet lies over the picture: move the middle of the picture above it. */
  #cover(): void {
    const phone = matchMedia("(max-width: 640px)").matches;
    this.stage.covered = phone ? this.#sheet.getBoundingClientRect().height : 0;
  }
}

/** The message of an error over the whole page. */
export function failure(text: string): HTMLElement {
  return h("div", { class: "failure", role: "alert" }, icon("close"), h("p", { text }));
}
