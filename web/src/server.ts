// Answers from the server of lexsplat view: any phrase, relations, edits, files.

import { type Answer, type Clicked, type Found, type Source, answered, painted } from "./answers";
import type { Dictionary } from "./dictionary";
import type { Geometry, Place } from "./geometry";
import { type Manifest, type ObjectEntry, PageError, type ServerEntry } from "./manifest";
import type { Presence } from "./rules";
import type { Stage } from "./stage";

interface Header {
  presence: Presence;
  threshold: number;
  instances: { center: number[]; size: number[] }[];
  understood?: string;
  note?: string;
  /** Whether nothing is certain: it holds words that the encoder does not know, or has no grammar. */
  unknown?: boolean;
  names?: { phrase: string; score: number }[];
  point?: [number, number, number];
}

export interface Details {
  center: number[];
  size: number[];
  size_meters?: number[];
  gaussians: number;
  pieces: number;
  views: { name: string; share: number }[];
}

/** The scene was edited meanwhile and is shown anew; the question was not answered. */
export class OutdatedError extends PageError {}

export class Server implements Source {
  readonly examples: string[];
  readonly entry: ServerEntry;

  constructor(
    readonly stage: Stage,
    readonly geometry: Geometry,
    readonly dictionary: Dictionary,
    manifest: Manifest,
    /** Show another version of the scene. */
    readonly reload: (manifest: Manifest | null) => Promise<void>,
  ) {
    this.entry = manifest.server!;
    this.examples = this.entry.examples;
  }

  complete(text: string): string[] {
    return this.dictionary.complete(text);
  }

  async answer(prompt: string, color: string): Promise<Answer | null> {
    const asked = { prompt, camera: this.stage.lens() };
    const { header, found } = await this.#found("ask", asked);
    this.dictionary.remember(prompt);
    const { note = "", unknown = false } = header;
    return answered(prompt, color, { ...found, phrase: header.understood || prompt, note, unknown });
  }

  async refine(answer: Answer): Promise<void> {
    if (answer.places !== null || !painted(answer)) {
      answer.places ??= [];
      return;
    }
    const manual = answer.threshold === answer.automatic ? null : answer.threshold;
    answer.asked = { ...answer.asked, threshold: manual };
    if (answer.from === "click") {
      answer.places = this.geometry.places(answer.scores, answer.threshold);
      return;
    }
    const { found } = await this.#found("ask", answer.asked);
    answer.places = found.places!;
  }

  async whatIs(x: number, y: number): Promise<Clicked | null> {
    const box = this.stage.canvas.getBoundingClientRect();
    const asked = { click: [x - box.left, y - box.top], camera: this.stage.lens() };
    const { header, found } = await this.#found("click", asked);
    return { names: header.names!, point: header.point!, found: { ...found, from: "click" } };
  }

  details(answer: Answer, instance: number | null): Promise<Details> {
    return this.#json("details", { ...answer.asked, instance });
  }

  objects(): Promise<ObjectEntry[]> {
    return this.#json("objects", {});
  }

  async edit(action: string, values: object): Promise<void> {
    await this.reload(await this.#json<Manifest>("edit", { ...values, action }));
  }

  /** The splats that an edit would apply to, and how many of the scene they are. */
  async preview(action: string, asked: object): Promise<{ splats: number[]; count: number }> {
    const content = new Uint8Array(await (await this.#post("preview", { ...asked, action })).arrayBuffer());
    const count = new DataView(content.buffer).getUint32(0, true);
    const splats: number[] = [];
    content.subarray(4).forEach((edited, i) => edited && splats.push(i));
    return { splats, count };
  }

  async setVocabulary(phrases: string[]): Promise<string[]> {
    return (this.entry.vocabulary = await this.#json<string[]>("vocabulary", { phrases }));
  }

  async colors(mode: string): Promise<Uint8Array> {
    return new Uint8Array(await (await this.#post("colors", { mode })).arrayBuffer());
  }

  async download(answer: Answer, instance: number | null, format: string): Promise<{ name: string; file: Blob }> {
    const response = await this.#post("download", { ...answer.asked, instance, format });
    const name = /filename\*=utf-8''(.+)/.exec(response.headers.get("Content-Disposition") ?? "")?.[1];
    return { name: decodeURIComponent(name ?? `selection${format}`), file: await response.blob() };
  }

  /** An answer: its length and JSON, then a score and an instance for each splat. */
  async #found(path: string, asked: object): Promise<{ header: Header; found: Found }> {
    const content = new Uint8Array(await (await this.#post(path, asked)).arrayBuffer());
    const start = 4 + new DataView(content.buffer).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(content.subarray(4, start))) as Header;
    const count = this.geometry.count;
    if (content.length !== start + 2 * count) throw new PageError("The server answered for another scene; reload the page.");
    const scores = Float32Array.from(content.subarray(start, start + count), (value) => value / 255);
    const splats: number[][] = header.instances.map(() => []);
    content.subarray(start + count).forEach((label, i) => label && splats[label - 1].push(i));
    const places = splats.filter((own) => own.length).map((own): Place => this.geometry.place(own));
    const { presence, threshold } = header;
    return { header, found: { phrase: "", from: "server", scores, presence, threshold, places, asked } };
  }

  async #json<T>(path: string, data: object): Promise<T> {
    return (await (await this.#post(path, data)).json()) as T;
  }

  async #post(path: string, data: object): Promise<Response> {
    let response: Response;
    try {
      response = await fetch(path, { method: "POST", body: JSON.stringify({ ...data, version: this.entry.version }) });
    } catch {
      throw new PageError("The server does not answer: start lexsplat view again.");
    }
    if (response.ok) return response;
    if (response.status === 409) {
      await this.reload(null);
      throw new OutdatedError("The scene was edited elsewhere; it is shown as it is now.");
    }
    const told = (await response.json().catch(() => null)) as { error?: { message?: string } } | null;
    throw new PageError(told?.error?.message ?? `The server answered ${response.status}; reload the page.`);
  }
}
