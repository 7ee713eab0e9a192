// Starts the page: reads the manifest and its files, and says in one line why it cannot.

import { App, failure } from "./app";
import { h } from "./dom";
import { Files, type Manifest, PageError } from "./manifest";
import { Stage } from "./stage";
import { TowerLoader } from "./tower-loader";

declare global {
  interface Window {
    /** For pages around this one and for tests: `await lexsplat.ready`, then `lexsplat.ask("red apple")`. */
    lexsplat: { ready: Promise<App>; app: App | null; loader: TowerLoader | null };
  }
}

async function start(root: HTMLElement): Promise<App> {
  theme();
  const files = new Files();
  const progress = h("p", { class: "progress", role: "status", text: "Loading" });
  const canvas = h("canvas", { tabindex: 0, "aria-label": "The scene. Arrow keys turn it, plus and minus approach." });
  root.append(canvas, progress);
  const manifest = await files.manifest();
  document.title = manifest.title;
  canvas.setAttribute("aria-label", `${manifest.title}. Arrow keys turn it, plus and minus approach.`);
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
  const { scene, language, words } = manifest;
  const bytes = manifest.files[scene.file].bytes;
  tell(`Loading ${scene.gaussians.toLocaleString("en")} Gaussians (${(bytes / 1e6).toFixed(1)} MB)`);
  const names = [scene.file, language.codes, words.phrases, words.table];
  const [splats, codes, phrases, table] = await Promise.all(names.map((name) => files.read(name)));
  if (codes.length !== 8 * scene.gaussians) {
    throw new PageError(`${language.codes}: expected codes of ${scene.gaussians} Gaussians, found ${codes.length / 8}; publish the scene again.`);
  }
  await stage.load(splats);
  const loader = manifest.text ? new TowerLoader(files, manifest) : null;
  window.lexsplat.loader = loader;
  return new App(stage, manifest, { codes, phrases: new TextDecoder().decode(phrases), table }, loader, root);
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
window.lexsplat = { ready, app: null, loader: null };
ready.then(
  (app) => (window.lexsplat.app = app),
  (error: unknown) => {
    const text = error instanceof PageError ? error.message : `The page could not start: ${String(error)}`;
    root.replaceChildren(failure(text));
    if (!(error instanceof PageError)) console.error(error);
  },
);
