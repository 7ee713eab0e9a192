// Starts the page: reads the manifest and its files, and says in one line why it cannot.

import { App } from "./app";
import { Dictionary } from "./dictionary";
import { h } from "./dom";
import { Geometry } from "./geometry";
import { Grammar } from "./grammar";
import { Kinds } from "./kinds";
import { Language } from "./language";
import { Files, type Manifest, PageError } from "./manifest";
import { failure } from "./notes";
import { Segments } from "./segments";
import { Server } from "./server";
import { Spelling } from "./spelling";
import { Stage } from "./stage";
import { Tables } from "./tables";
import { firstTheme, ground } from "./theme";
import { TowerLoader } from "./tower-loader";
import { ownModule } from "./wasm";

declare global {
  interface Window {
    /** For pages around this one and for tests: `await lexsplat.ready`, then `lexsplat.ask("red apple")`. */
    lexsplat: { ready: Promise<App>; app: App | null };
  }
}

const LONGEST_WAIT = 5_000; // milliseconds

async function start(root: HTMLElement): Promise<App> {
  firstTheme();
  const files = new Files();
  const progress = h("p", { class: "progress", role: "status", text: "Loading" });
  const keys = "Arrow keys turn it, plus and minus approach, Enter tells what is in its middle.";
  const canvas = h("canvas", { tabindex: 0, "aria-label": `The scene. ${keys}` });
  root.append(canvas, progress);
  const manifest = await files.manifest();
  document.title = manifest.title;
  canvas.setAttribute("aria-label", `${manifest.title}. ${keys}`);
  const { gaussians, file } = manifest.scene;
  progress.textContent = `Loading ${gaussians.toLocaleString("en")} Gaussians (${(manifest.files[file].bytes / 1e6).toFixed(1)} MB)`;
  await ownModule;
  const stage = new Stage(canvas, manifest);
  stage.background = ground();
  const app = await show(files, manifest, stage, root);
  progress.remove();
  root.classList.add("ready");
  await Promise.all([app.run(() => app.restore()), app.answering]);
  return app;
}

/** The page of a scene: first its picture, then what answers. */
async function show(files: Files, manifest: Manifest, stage: Stage, root: HTMLElement): Promise<App> {
  stage.manifest = manifest;
  const { scene } = manifest;
  scene.budget = Math.min(scene.budget, stage.budget);
  await stage.load(await files.read(scene.file));
  const geometry = new Geometry(stage.mesh, scene.gaussians, manifest.selection_rule);
  if (manifest.server) {
    const phrases = new TextDecoder().decode(await files.read(manifest.words.phrases));
    const server = new Server(stage, geometry, new Dictionary(phrases, new Uint8Array(0), 0, new Grammar(manifest.grammar)), manifest, async (next) => {
      app.dispose();
      const shown = next ? files.take(next) : await files.manifest();
      root.replaceChildren(stage.canvas);
      window.lexsplat.app = await show(files, shown, stage, root);
      await window.lexsplat.app.restore();
      if (document.activeElement === document.body) stage.canvas.focus({ preventScroll: true }); // what had the focus is gone
    });
    const app = new App(stage, geometry, manifest, Promise.resolve(server), server, root);
    return app;
  }
  return new App(stage, geometry, manifest, firstPicture(stage).then(() => tables(files, manifest, stage, geometry)), null, root);
}

/** The first picture with splats; where none is in view, the words wait a moment only. */
function firstPicture(stage: Stage): Promise<void> {
  return Promise.race([stage.shown, new Promise<void>((resolve) => setTimeout(resolve, LONGEST_WAIT))]);
}

/** Everything that answers without a server. */
async function tables(files: Files, manifest: Manifest, stage: Stage, geometry: Geometry): Promise<Tables> {
  const { scene, words } = manifest;
  const language = manifest.language!;
  const { english } = words;
  const [phrases, codes, table, segments, members, letters] = await Promise.all([
    files.read(words.phrases), files.read(language.codes), files.read(words.table!),
    language.segments ? files.read(language.segments) : null, files.read(language.objects),
    english ? files.read(english.file) : null,
  ]);
  if (codes.length !== 8 * scene.gaussians) {
    throw new PageError(`${language.codes}: expected codes of ${scene.gaussians} Gaussians, found ${codes.length / 8}; publish the scene again.`);
  }
  const codesOf = new Language(codes, language.num_codes);
  const loader = manifest.text ? new TowerLoader(files, manifest) : null;
  const whole = segments && new Segments(segments, scene.gaussians, language.segment_rule!);
  const kinds = new Kinds(members, geometry, manifest.objects ?? [], manifest.kinds ?? {});
  const dictionary = new Dictionary(new TextDecoder().decode(phrases), table, language.num_codes, new Grammar(manifest.grammar));
  const spelling = english && letters ? new Spelling(letters, english.things) : null;
  const parts = language.part_rule && manifest.words.rule ? { ...language.part_rule, words: manifest.words.rule } : null;
  return new Tables(stage, geometry, codesOf, whole, parts, dictionary, loader, kinds, spelling, english?.only ?? false);
}

const root = document.getElementById("page")!;
const ready = start(root);
window.lexsplat = { ready, app: null };
ready.then(
  (app) => (window.lexsplat.app = app),
  (error: unknown) => {
    const text = error instanceof PageError ? error.message : `The page could not start: ${String(error)}`;
    root.replaceChildren(failure(text));
    if (!(error instanceof PageError)) console.error(error);
  },
);
