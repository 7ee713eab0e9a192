// Writes the bundle that the Python package ships: node build.mjs [FOLDER]
import { readFileSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import binaryen from "binaryen";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const output = process.argv[2] ?? join(here, "../src/lexsplat/scenes/publishing/page");

/** What the page calls of Spark's WebAssembly: it reads splat files and sorts; levels of detail are left out. */
const CALLED = /^(memory|__wbindgen_|__externref_|wasm_start|simd_enabled|decode_to_(packed|ext)splats|chunkdecoder_|__wbg_chunkdecoder|sort32_splats)/;

/** Puts Spark's WebAssembly into a file of its own, page.wasm, which is a third smaller than base64 in the script. */
const wasmBeside = {
  name: "wasm-beside",
  setup(run) {
    run.onLoad({ filter: /spark\.module\.js$/ }, ({ path }) => {
      const parts = readFileSync(path, "utf8").split(/const WASM = decode64\("([\w+/]+=*)"\)\.buffer;\s*const WASM_MODULE = WebAssembly\.compile\(WASM\);/);
      if (parts.length !== 3) throw new Error(`${path}: expected one embedded WebAssembly`);
      writeFileSync(join(output, "page.wasm"), shrunk(Buffer.from(parts[1], "base64")));
      const own = JSON.stringify(join(here, "src/wasm.ts"));
      return { contents: `import { sparkModule as WASM_MODULE } from ${own};\n${parts[0]}${parts[2]}` };
    });
  },
};

function shrunk(content) {
  const { MVP, MutableGlobals, NontrappingFPToInt, SIMD128, BulkMemory, BulkMemoryOpt, SignExt, ReferenceTypes, Multivalue } = binaryen.Features;
  const module = binaryen.readBinary(content);
  module.setFeatures(MVP | MutableGlobals | NontrappingFPToInt | SIMD128 | BulkMemory | BulkMemoryOpt | SignExt | ReferenceTypes | Multivalue);
  for (const { name } of WebAssembly.Module.exports(new WebAssembly.Module(content))) {
    if (!CALLED.test(name)) module.removeExport(name);
  }
  module.runPasses(["remove-unused-module-elements"]);
  return module.emitBinary();
}

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
  plugins: [wasmBeside],
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
const head = "page.js and page.wasm contain these packages. The rest of page.js is lexsplat (Apache-2.0).\n";
writeFileSync(join(output, "LICENSES.txt"), [head, ...licenses].join(`\n${"-".repeat(72)}\n\n`));
