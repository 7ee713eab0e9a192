// The page: one picture, one search bar, and what was found.

import * as THREE from "three";
import { Budget } from "./budget";
import { type Answer, type Clicked, type Source, answered, freeColor, painted, spoken } from "./answers";
import { type CardHost, Cards } from "./card";
import { h, isTouched } from "./dom";
import { Edits } from "./edits";
import type { Geometry, Place } from "./geometry";
import { type Manifest, type ObjectEntry, PageError, type ViewEntry } from "./manifest";
import { Measure } from "./measure";
import { Overlay } from "./overlay";
import { Notes } from "./notes";
import { objectsPanel, titleOf, viewsPanel } from "./panels";
import { prompts } from "./questions";
import { type Change, MOST_PROMPTS, type Mode, Painter, type Preview } from "./painter";
import { SearchBar } from "./search";
import { OutdatedError, Server } from "./server";
import { type Stage, pose } from "./stage";
import { readState, writeState } from "./state";
import { Tables } from "./tables";
import { toolbar } from "./tools";
import { vantage } from "./vantage";
import { workbench } from "./workbench";

const FARTHEST = 50; // of a camera in a link from the middle of the scene, in radii of the scene
const MOST_AT_ONCE = 200_000; // splats; in larger scenes, colors come before places

export class App {
  readonly answers: Answer[] = [];
  readonly search: SearchBar;
  readonly measure: Measure;
  readonly views: ReturnType<typeof viewsPanel>;
  readonly objects: ReturnType<typeof objectsPanel>;
  /** Who answers, once its files are there. */
  source: Source | null = null;
  readonly answering: Promise<Source>;
  readonly budget: Budget | null;
  readonly edits: Edits | null;
  readonly #painter: Painter;
  readonly #overlay: Overlay;
  readonly #cards: Cards;
  readonly #sheet: HTMLElement;
  readonly #tries = h("p", { class: "examples" });
  readonly #notes: Notes;
  readonly #bounds: { center: THREE.Vector3; radius: number };
  readonly #life = new AbortController();
  #mode: Mode = "marks";
  #preview: Preview | null = null;
  #previewed = false;
  #colors = 0;
  /** Counts the questions that replace what was asked before. */
  #turn = 0;
  #view = "";
  #written = "";

  constructor(
    readonly stage: Stage,
    readonly geometry: Geometry,
    readonly manifest: Manifest,
    source: Promise<Source>,
    readonly server: Server | null,
    root: HTMLElement,
  ) {
    this.#painter = new Painter(stage.mesh, geometry.count, stage.paints);
    this.budget = Budget.needed(geometry, manifest.scene.budget);
    stage.onRest = () => void (this.budget && this.#painter.leaveOut(this.budget.choose(stage.camera)));
    this.#bounds = geometry.bounds();
    this.search = new SearchBar({
      complete: (text) => this.source?.complete(text) ?? [],
      ask: (text, add) => this.run(() => this.#typed(text, add)),
    });
    this.answering = source.then((found) => this.#begin(found));
    this.views = viewsPanel(manifest.views, (view) => this.jump(view), this.server !== null);
    this.#overlay = new Overlay(stage);
    this.measure = new Measure(stage, geometry, this.#overlay, manifest);
    const list = async (): Promise<ObjectEntry[]> => (this.server ? this.server.objects() : (manifest.objects ?? []));
    this.objects = objectsPanel(list, this.measure.sizes(), (object) => this.#goTo(object));
    this.#cards = new Cards(this.#host);
    this.#sheet = h("section", { class: "sheet", "aria-label": "What was found" }, this.#tries, this.#cards.element);
    this.#notes = new Notes(this.#sheet, (phrase, add) => this.run(() => this.ask(phrase, add)));
    this.#sheet.append(this.#notes.element);
    const tools = toolbar(this, this.#life.signal);
    const waiting = [this.search.element, this.#cards.element, this.#tries, tools, this.objects.element];
    this.edits = server && new Edits(server, waiting, (text) => this.note(text), (work) => this.run(work));
    root.append(
      h("div", { class: "bar" }, this.search.element, this.#sheet),
      titleOf(manifest),
      tools,
      this.views.element,
      this.objects.element,
      ...(this.server ? [this.views.figure] : []),
      this.#overlay.element,
    );
    stage.onMove = () => this.#moved();
    stage.onDraw = () => this.#overlay.update();
    this.#listen();
    new ResizeObserver(() => this.#cover()).observe(this.#sheet);
    new ResizeObserver(() => root.style.setProperty("--tools", `${tools.offsetWidth}px`)).observe(tools);
  }

  /** From now on questions are answered. */
  #begin(source: Source): Source {
    this.source = source;
    const { examples } = source;
    this.search.suggest(examples[0] ?? "");
    const tried = (text: string) => h("button", { type: "button", text, onclick: () => this.run(() => this.ask(text, false)) });
    if (examples.length > 0) this.#tries.append("Try: ", ...examples.map(tried));
    return source;
  }

  /** End before another version of the scene is shown; the link keeps what was asked and the view. */
  dispose(): void {
    this.#life.abort();
    this.#writeNow();
  }

  /** Do something; what fails is told in one line. */
  run(work: () => Promise<void>): Promise<void> {
    return work().catch((error: unknown) => {
      // An edit may have put another page of the scene in the place of this one.
      (window.lexsplat.app ?? this).note(error instanceof PageError ? error.message : `That failed: ${String(error)}`);
      if (!(error instanceof PageError)) console.error(error);
    });
  }

  /** Take up the state of the link. */
  async restore(): Promise<void> {
    const state = readState(location.hash);
    const view = this.manifest.views.find(({ name }) => name === state.view) ?? null;
    if (state.camera) {
      const [x, y, z, a, b, c, fov] = state.camera;
      const { center, radius } = this.#bounds;
      const near = (point: THREE.Vector3): THREE.Vector3 => point.sub(center).clampLength(0, FARTHEST * radius).add(center);
      const [placed, target] = [near(new THREE.Vector3(x, y, z)), near(new THREE.Vector3(a, b, c))];
      if (placed.distanceTo(target) < 1e-6 * radius) target.copy(center);
      await this.stage.fly(placed, target, false, THREE.MathUtils.clamp(fov, 5, 120));
    } else this.start(view);
    this.#mode = state.mode;
    this.onMode(state.mode === "heat");
    const joined = (prompts: string[]): string => prompts.join("\n").toLowerCase();
    if (joined(state.prompts) === joined(this.answers.map((answer) => answer.prompt))) return;
    this.clear();
    const turn = this.#turn;
    for (const prompt of state.prompts) if (turn === this.#turn) await this.ask(prompt, true, !view && !state.camera);
  }

  /** Ask for something; several prompts are separated by commas. Answers to what was asked before a new question are dropped. */
  async ask(text: string, add = false, fly = true): Promise<void> {
    if (!add) this.#turn++;
    const turn = this.#turn;
    this.#preview = null;
    if (!this.source) this.note("One moment: the words are loading.");
    const source = await this.answering;
    const fresh: Answer[] = [];
    const unknown: string[] = [];
    for (const prompt of prompts(text, source.dictionary.grammar)) {
      const answer = await source.answer(prompt, freeColor([]));
      if (answer) fresh.push(answer);
      else unknown.push(prompt);
    }
    if (turn !== this.#turn) return;
    this.note("");
    if (!add) this.answers.length = 0;
    for (const answer of fresh) this.#add(answer);
    unknown.forEach((prompt) => this.#unknown(prompt));
    if (this.geometry.count > MOST_AT_ONCE && !this.stage.software) {
      this.#paint(); // colors first, then places
      await new Promise((resolve) => setTimeout(resolve));
    }
    for (const answer of [...this.answers]) await source.refine(answer);
    if (turn !== this.#turn) return;
    this.#paint();
    this.#refresh();
    if (fresh.length) this.#notes.say(fresh.map((answer) => `${answer.prompt}: ${spoken(answer)}`).join(". "));
    const first = fresh.find((answer) => painted(answer) && answer.places?.length);
    if (fly && first) this.#flyTo(first);
  }

  /** Ask what was typed, if need be of the scene as it is by now; what fails is typed again. */
  async #typed(text: string, add: boolean): Promise<void> {
    try {
      await this.ask(text, add);
    } catch (error) {
      const app = window.lexsplat.app ?? this;
      if (error instanceof OutdatedError && app !== this) return app.#typed(text, add).then(() => app.note(error.message));
      app.search.input.value ||= text;
      throw error;
    }
  }

  #add(answer: Answer): void {
    if (this.answers.length === MOST_PROMPTS) this.answers.shift();
    answer.color = freeColor(this.answers);
    this.answers.push(answer);
  }

  clear(): void {
    this.#turn++;
    this.answers.length = 0;
    this.#preview = null;
    this.note("");
    this.measure.clear();
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
    this.views.mark(view.name);
    this.#write();
  }

  start(view: ViewEntry | null): void {
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
    if (place) this.stage.flyTo(place, vantage(place, this.manifest.views, this.stage.camera.position, this.geometry));
  }

  #paint(): void {
    const shown = this.answers.filter(painted);
    this.#painter.paint(
      shown.map((answer) => ({ ...answer, splats: answer.places?.flatMap((place) => place.splats) ?? null })),
      this.#mode,
      this.#preview,
    );
    this.stage.paint(this.#preview !== null || this.#previewed);
    this.#previewed = this.#preview !== null;
    this.#write();
  }

  #refresh(): void {
    this.#cards.update(this.answers);
    this.#sheet.classList.toggle("asked", this.answers.length > 0);
  }

  readonly #host: CardHost = {
    ask: (phrase) => this.run(() => this.ask(phrase, true)),
    show: (one, step) => {
      const count = one.places?.length ?? 0;
      one.place = count ? (one.place + step) % count : 0;
      this.#refresh();
      this.#flyTo(one);
    },
    remove: (one) => {
      this.answers.splice(this.answers.indexOf(one), 1);
      this.#preview = null;
      this.#paint();
      this.#refresh();
      if (isTouched()) this.stage.canvas.focus();
      else this.search.input.focus();
    },
    changed: (one) => {
      one.place = 0;
      one.places = null;
      this.#paint();
      clearTimeout(this.#later);
      this.#later = setTimeout(() => this.run(() => this.#refine(one)), 250);
    },
    repaint: () => {
      this.#paint();
      this.#refresh();
    },
    further: (one) => this.server && workbench(one, this.server, this.geometry, this.stage.camera.up, this.#bench()),
    closed: () => {
      this.#preview = null;
      this.#paint();
    },
  };

  async #refine(answer: Answer): Promise<void> {
    await (await this.answering).refine(answer);
    if (!this.answers.includes(answer)) return;
    if (answer.presence === "no" && answer.anyway && !answer.places?.length) answer.places = this.geometry.best(answer.scores);
    this.#paint();
    this.#refresh();
  }

  #bench() {
    return {
      preview: (preview: Preview | null) => {
        this.#preview = preview;
        this.#paint();
      },
      jump: (name: string) => {
        const view = this.manifest.views.find((one) => one.name === name);
        if (view) this.jump(view);
      },
      edit: (action: Change, values: object) => this.edits?.do(action, values),
      run: (work: () => Promise<void>) => this.run(work),
    };
  }
  #later: ReturnType<typeof setTimeout> | undefined;

  /** Nothing in the page can tell what a prompt means: offer the nearest phrases, and the text model if there is one. */
  #unknown(prompt: string): void {
    if (!(this.source instanceof Tables)) return;
    const { dictionary, loader } = this.source;
    const load = loader?.waiting ? { bytes: loader.bytes, agreed: () => this.run(() => loader.agree().then(() => this.ask(prompt, true))) } : null;
    this.#notes.unknown(prompt, dictionary, load);
  }

  note(text: string): void {
    this.#notes.tell(text);
  }

  /** What is under a point of the page, told as buttons that ask for it. */
  async whatIs(x: number, y: number): Promise<Clicked | null> {
    const clicked = await (await this.answering).whatIs(x, y);
    if (!clicked) {
      this.note("Nothing is there.");
      return null;
    }
    const sure = clicked.names.filter(({ score }) => score >= 0.5);
    const shown = sure.length ? sure.slice(0, 4) : clicked.names.slice(0, 2);
    const { found } = clicked;
    if (found) {
      const before = this.answers.findIndex((answer) => answer.from === "click");
      if (before >= 0) this.answers.splice(before, 1);
      const name = sure.length ? `clicked: ${shown[0].phrase}` : "what was clicked";
      this.#add(answered(name, "", { ...found, phrase: name }));
      this.#preview = null;
      this.#paint();
      this.#refresh();
    }
    this.measure.clear();
    this.#overlay.show([new THREE.Vector3(...clicked.point)]);
    this.note(sure.length ? "This may be:" : "No phrase of this page fits well. Nearest:");
    this.#notes.offer(shown.map(({ phrase, score }) => ({ phrase, title: `relevancy ${score.toFixed(2)}` })), false);
    this.#notes.append(h("p", { class: "fine", text: `at ${clicked.point.map((value) => value.toFixed(2)).join(", ")}` }));
    this.stage.draw();
    return clicked;
  }

  /** Stand before an object of the list. */
  #goTo({ name, center, size }: ObjectEntry): void {
    const place: Place = { center: new THREE.Vector3(...center), radius: Math.hypot(...size) / 2, splats: [] };
    this.#overlay.show([place.center]);
    this.note(`${name}: ${this.measure.sides(size)}`);
    this.stage.flyTo(place, vantage(place, this.manifest.views, this.stage.camera.position, this.geometry));
  }

  /** Told whether heat is shown. */
  onMode: (heat: boolean) => void = () => undefined;

  toggleHeat(): boolean {
    this.#mode = this.#mode === "heat" ? "marks" : "heat";
    this.#paint();
    const each = this.answers.filter(painted).length > 1 ? "each prompt in its own color, " : "";
    this.note(this.#mode === "heat" ? `Heat: ${each}brighter where the words fit better.` : "");
    return this.#mode === "heat";
  }

  /** Show language, codes, uncertainty and the photo's colors in turn; true if they are not the photo's. */
  async nextColors(): Promise<boolean> {
    const modes = this.server?.entry.modes ?? [];
    const next = (this.#colors + 1) % (modes.length + 1);
    this.#painter.recolor(next ? await this.server!.colors(modes[next - 1]) : null);
    this.#colors = next;
    this.note(next ? `Colors: ${modes[next - 1]}` : "");
    this.stage.draw();
    return next > 0;
  }

  #listen(): void {
    const { canvas } = this.stage;
    const { signal } = this.#life;
    let down: { x: number; y: number; time: number } | null = null;
    canvas.addEventListener("pointerdown", (event) => {
      down = event.isPrimary && event.button === 0 ? { x: event.clientX, y: event.clientY, time: event.timeStamp } : null;
    }, { signal });
    canvas.addEventListener("pointerup", (event) => {
      if (!down || Math.hypot(event.clientX - down.x, event.clientY - down.y) > 6 || event.timeStamp - down.time > 600) return;
      down = null;
      this.pick(event.clientX, event.clientY);
    }, { signal });
    addEventListener("hashchange", () => location.hash !== this.#written && this.run(() => this.restore()), { signal });
  }

  /** A click, or Enter for the middle of the picture: a point to measure, else the question what is there. */
  pick(x: number, y: number): void {
    if (this.measure.active) this.note(this.measure.click(x, y));
    else this.run(async () => void (await this.whatIs(x, y)));
  }

  async copyLink(): Promise<void> {
    this.#writeNow();
    try {
      await navigator.clipboard.writeText(location.href);
      this.note("The link is copied. It carries the prompts and the view.");
    } catch {
      this.note(`Copy the address of this page: ${location.href}`);
    }
  }

  #moved(): void {
    if (this.#view) {
      const view = this.manifest.views.find(({ name }) => name === this.#view);
      if (view && pose(view).position.distanceTo(this.stage.camera.position) > this.#bounds.radius * 1e-3) {
        this.#view = "";
        this.views.mark("");
      }
    }
    this.#write();
  }

  /** Write the state into the link, at most four times a second. */
  #write(): void {
    clearTimeout(this.#writing);
    this.#writing = setTimeout(() => this.#writeNow(), 250);
  }
  #writing: ReturnType<typeof setTimeout> | undefined;

  #writeNow(): void {
    clearTimeout(this.#writing);
    const { camera, target } = this.stage;
    this.#written = writeState({
      prompts: this.answers.filter((answer) => answer.from !== "click").map((answer) => answer.prompt),
      view: this.#view,
      camera: [...camera.position.toArray(), ...target.toArray(), camera.fov],
      mode: this.#mode,
    });
    try {
      history.replaceState(null, "", this.#written);
    } catch {
      // a page without an address of its own
    }
  }

  /** On phones the sheet lies over the picture: move the middle of the picture above it. */
  #cover(): void {
    const phone = matchMedia("(max-width: 640px)").matches;
    this.stage.covered = phone ? this.#sheet.getBoundingClientRect().height : 0;
  }
}
