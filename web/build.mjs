// Writes the bundle that the Python package ships: node build.mjs [FOLDER]
import { readFileSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const output = process.argv[2] ?? join(here, "../src/lexsplat/scenes/publishing/page");

await build({
  absWorkingDir: here,
  entryPoints: { page: "src/main.ts" },
  outdir: output,
  bundle: true,
  minify: true,
  format: "iife", // a classic script also runs under file://, where it says what to do
  target: "es2022",
  charset: "utf8",
  legalComments: "none", // the licenses are in LICENSES.txt
  logLevel: "warning",
});
await build({
  absWorkingDir: here,
  entryPoints: { page: "src/page.css" },
  outdir: output,
  minify: true,
  logLevel: "warning",
});

const packages = ["three", "@sparkjsdev/spark", "@huggingface/tokenizers"];
const licenses = packages.map((name) => {
  const folder = join(here, "node_modules", name);
  const { version, license, homepage } = JSON.parse(readFileSync(join(folder, "package.json"), "utf8"));
  const text = readFileSync(join(folder, "LICENSE"), "utf8").trim();
  return `${name} ${version} (${license})\n${homepage}\n\n${text}\n`;
});
const head = "page.js contains these packages. The rest of it is lexsplat (Apache-2.0).\n";
writeFileSync(join(output, "LICENSES.txt"), [head, ...licenses].join(`\n${"-".repeat(72)}\n\n`));
