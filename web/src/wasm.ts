// Spark's WebAssembly, which reads splat files and sorts: page.wasm.

import { PageError, unchecked } from "./manifest";

async function compiled(): Promise<WebAssembly.Module> {
  const content = await unchecked("page.wasm");
  try {
    return await WebAssembly.compile(content);
  } catch (error) {
    throw new PageError(`page.wasm: expected WebAssembly, found: ${String(error)}; copy the folder again.`);
  }
}

/** Fails with a line for the visitor. */
export const ownModule = compiled();
/** What Spark waits for; it never fails, because nothing catches what Spark throws. */
export const sparkModule = ownModule.catch(() => new Promise<never>(() => undefined));
