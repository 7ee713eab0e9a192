// Starts the page: reads the manifest and its files, and says in one line why it cannot.

import { App, failure } from "./app";
import { Dictionary } from "./dictionary";
import { h } from "./dom";
import { Geometry } from "./geometry";
import { Kinds } from "./kinds";
import { Language } from "./language";
import { Files, type Manifest, PageError } from "./manifest";
import { Segments } from "./segments";
import { Server } from "./server";
import { Stage } from "./stage";
import { Tables } from "./tables";
import { TowerLoader } from "./tower-loader";

declare global {
  interface Window {
    /** For pages around this one and for tests: `await lexsplat.ready`, then `lexsplat.ask("red apple")`. */
    lexsplat: { ready: Promise<App>; app: App | null };
  }
}

async function start(root: HTMLElement): Promise<App> {
  theme();
  const files = new Files();
  const progress = h("p", { class: "progress", role: "status", text: "Loading" });
  const keys = "Arrow keys turn it, plus and minus approach, Enter tells what is in its middle.";
  const canvas = h("canvas", { tabindex: 0, "aria-label": `The scene. ${keys}` });
  root.append(canvas, progress);
  const manifest = await files.manifest();
  document.title = manifest.title;
  canvas.setAttribute("aria-label", `${manifest.title}. ${keys}`);
  if (!document.createElement("canvas").getContext("webgl2")) {
    throw new PageError("This page needs WebGL 2, which this browser does not offer; use a newer browser or allow hardware acceleration.");
  }
  const stage = new Stage(canvas, manifest);
  stage.background = getComputedStyle(document.documentElement).getPropertyValue("--ground").trim();
  const app = await load(files, manifest, stage, root, (text) => (progress.textContent = text));
  await app.restore();
  progress.remove();
  root.classList.add("ready");
  return app;
}

async function load(
  files: Files, manifest: Manifest, stage: Stage, root: HTMLElement, tell: (text: string) => void,
): Promise<App> {
  const { scene, words } = manifest;
  const bytes = manifest.files[scene.file].bytes;
  tell(`Loading ${scene.gaussians.toLocaleString("en")} Gaussians (${(bytes / 1e6).toFixed(1)} MB)`);
  stage.manifest = manifest;
  const [splats, phrases] = await Promise.all([files.read(scene.file), files.read(words.phrases)]);
  const list = new TextDecoder().decode(phrases);
  if (manifest.server) {
    await stage.load(splats);
    const geometry = new Geometry(stage.mesh, scene.gaussians);
    const server = new Server(stage, geometry, new Dictionary(list, new Uint8Array(0), 0), manifest, async (next) => {
      app.dispose();
      const shown = next ? files.take(next) : await files.manifest();
      root.replaceChildren(stage.canvas);
      window.lexsplat.app = await load(files, shown, stage, root, () => undefined);
      await window.lexsplat.app.restore();
    });
    const app = new App(stage, geometry, manifest, server, root);
    return app;
  }
  const { language } = manifest;
  const [codes, table, segments, members] = await Promise.all([
    files.read(language!.codes), files.read(words.table!), language!.segments ? files.read(language!.segments) : null,
    files.read(language!.objects),
  ]);
  if (codes.length !== 8 * scene.gaussians) {
    throw new PageError(`${language!.codes}: expected codes of ${scene.gaussians} Gaussians, found ${codes.length / 8}; publish the scene again.`);
  }
  await stage.load(splats);
  const geometry = new Geometry(stage.mesh, scene.gaussians);
  const codesOf = new Language(codes, language!.num_codes);
  const loader = manifest.text ? new TowerLoader(files, manifest) : null;
  const whole = segments && new Segments(segments, scene.gaussians, language!.segment_rule!);
  const kinds = new Kinds(members, geometry, manifest.objects ?? [], manifest.kinds ?? {});
  const dictionary = new Dictionary(list, table, language!.num_codes);
  const tables = new Tables(stage, geometry, codesOf, whole, dictionary, loader, kinds);
  return new App(stage, geometry, manifest, tables, root);
}

/** Light or dark as chosen before, else as the system has it. */
function theme(): void {
  let stored: string | null = null;
  try {
    stored = localStorage.getItem("lexsplat-theme");
  } catch {
    // a page from a file may not store anything
  }
  const system = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
  document.documentElement.dataset.theme = stored === "light" || stored === "dark" ? stored : system;
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
