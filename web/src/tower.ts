// The text tower of a CLIP or SigLIP in plain TypeScript: a phrase to its relevancy for every code, without a server.

import type { Table } from "./language";
import type { EverydayRule, Manifest } from "./manifest";
import { type Heights, besideThing, hasColor, heightsOf, isPart, relevancyOf, thingOfPart } from "./rules";
import { PhraseTokenizer } from "./tokenizer";

/** What a phrase means to the codes of the scene. */
export interface Description {
  table: Table;
  heights: Heights;
  best: Float32Array;
  /** The heights that presence compares the phrase with: `best`, or `colored` for a phrase with a color. */
  compared: Float32Array;
  rule: EverydayRule;
  /** Distributions of the scene's objects, and the best heights for phrases with a color; null without segments. */
  places: Float32Array | null;
  colored: Float32Array | null;
  /** How well the names of parts fit the codes [W, K]; null without segments. */
  fits: Float32Array | null;
}

interface Matrix {
  data: Float32Array | Int16Array | Int8Array;
  /** Factor of each row of integer weights. */
  factors: Float32Array | null;
  rows: number;
  columns: number;
}

/** The tensors of a safetensors file: float32, or integer weights with factors. */
export function readSafetensors(content: Uint8Array<ArrayBuffer>): Map<string, Matrix> {
  const view = new DataView(content.buffer, content.byteOffset, content.byteLength);
  const length = Number(view.getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(content.subarray(8, 8 + length))) as Record<
    string,
    { dtype: "I8" | "I16" | "F32"; shape: number[]; data_offsets: [number, number] }
  >;
  const tensors = new Map<string, Matrix>();
  for (const [name, entry] of Object.entries(header)) {
    if (name === "__metadata__") continue;
    const [start, end] = entry.data_offsets.map((offset) => offset + 8 + length);
    const bytes = content.slice(start, end).buffer;
    const data = new { I8: Int8Array, I16: Int16Array, F32: Float32Array }[entry.dtype](bytes);
    const columns = entry.shape.at(-1) ?? 1;
    tensors.set(name, { data, factors: null, rows: data.length / columns, columns });
  }
  for (const [name, tensor] of tensors) tensor.factors = (tensors.get(`${name}.factor`)?.data as Float32Array) ?? null;
  return tensors;
}

const QUICK_GELU = (x: number): number => x / (1 + Math.exp(-1.702 * x));
const GELU = (x: number): number => 0.5 * x * (1 + erf(x * Math.SQRT1_2));

const TANH_GELU = (x: number): number => 0.5 * x * (1 + Math.tanh(0.7978845608028654 * (x + 0.044715 * x * x * x)));
const ACTIVATIONS: Record<string, (x: number) => number> = { quick_gelu: QUICK_GELU, gelu: GELU, gelu_pytorch_tanh: TANH_GELU };

/** Abramowitz and Stegun 7.1.26; the error is below 1.5e-7. */
function erf(x: number): number {
  const t = 1 / (1 + 0.3275911 * Math.abs(x));
  const poly = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
  return Math.sign(x) * (1 - poly * Math.exp(-x * x));
}

/** The mean direction of vectors. */
function unit(vectors: Float32Array[]): Float32Array {
  const sum = vectors[0].map((_, d) => vectors.reduce((total, vector) => total + vector[d], 0));
  const length = Math.sqrt(sum.reduce((total, value) => total + value * value, 0));
  return sum.map((value) => value / length);
}

export class TextTower {
  readonly #tensors: Map<string, Matrix>;
  readonly #tokenizer: PhraseTokenizer;
  readonly #text: NonNullable<Manifest["text"]>;
  readonly #rule: EverydayRule;
  readonly #heads: number;
  readonly #activation: (x: number) => number;
  readonly #layers: number;

  constructor(weights: Uint8Array<ArrayBuffer>, tokenizer: Uint8Array, manifest: Manifest) {
    this.#tensors = readSafetensors(weights);
    const positions = this.#get("embeddings.position_embedding.weight").rows;
    this.#text = manifest.text!;
    this.#rule = manifest.words.rule!;
    const file = JSON.parse(new TextDecoder().decode(tokenizer)) as object;
    this.#tokenizer = new PhraseTokenizer(file, positions, this.#text.padding);
    this.#heads = this.#text.heads;
    this.#activation = ACTIVATIONS[this.#text.activation];
    let layers = 0;
    while (this.#tensors.has(`encoder.layers.${layers}.layer_norm1.weight`)) layers++;
    this.#layers = layers;
  }

  /** Heights and relevancy of a phrase for every code. */
  describe(phrase: string): Description {
    const rule = this.#rule;
    const heights = this.#heights(phrase);
    const best = this.#get("best").data as Float32Array;
    const tables = ["places", "best_colored", "part_fits"];
    const [places, colored, fits] = tables.map((name) => (this.#tensors.get(name)?.data as Float32Array) ?? null);
    const compared = colored && hasColor(phrase, rule) && !isPart(phrase, rule) ? colored : best;
    const thing = thingOfPart(phrase, rule);
    const rivals = thing ? besideThing(heights, this.#heights(thing), compared, rule) : compared;
    return { table: relevancyOf(heights, rivals, rule), heights, best, compared, rule, places, colored, fits };
  }

  #heights(phrase: string): Heights {
    const embedding = unit(this.#text.templates.map((template) => this.embed(template.replace("{}", phrase))));
    const [codewords, mean] = ["codewords", "mean"].map((name) => this.#get(name).data as Float32Array);
    return heightsOf(codewords, embedding, mean, this.#rule);
  }

  /** The embedding of a phrase, of unit length. */
  embed(phrase: string): Float32Array {
    const tokens = this.#tokenizer.encode(phrase);
    const words = this.#get("embeddings.token_embedding.weight");
    const positions = this.#get("embeddings.position_embedding.weight");
    const width = words.columns;
    let x = new Float32Array(tokens.length * width);
    tokens.forEach((token, t) => {
      const [a, b] = [words.factors?.[token] ?? 1, positions.factors?.[t] ?? 1];
      for (let d = 0; d < width; d++) x[t * width + d] = words.data[token * width + d] * a + positions.data[t * width + d] * b;
    });
    for (let layer = 0; layer < this.#layers; layer++) x = this.#block(x, tokens.length, `encoder.layers.${layer}.`);
    const last = this.#norm(x.slice(-width), "final_layer_norm"); // the last token: the end, or for SigLIP the last place
    const out = this.#linear(last, 1, "text_projection");
    return unit([out]);
  }

  #block(x: Float32Array<ArrayBuffer>, count: number, name: string): Float32Array<ArrayBuffer> {
    const attended = this.#attend(this.#norm(x, `${name}layer_norm1`), count, `${name}self_attn.`);
    const middle = x.map((value, i) => value + attended[i]);
    const hidden = this.#linear(this.#norm(middle, `${name}layer_norm2`), count, `${name}mlp.fc1`);
    const out = this.#linear(hidden.map(this.#activation), count, `${name}mlp.fc2`);
    return middle.map((value, i) => value + out[i]);
  }

  /** Self-attention of `count` tokens: to those before each, or with padding to all. */
  #attend(x: Float32Array, count: number, name: string): Float32Array {
    const [q, k, v] = ["q_proj", "k_proj", "v_proj"].map((part) => this.#linear(x, count, name + part));
    const all = this.#text.padding !== null;
    const width = x.length / count;
    const size = width / this.#heads;
    const blended = new Float32Array(x.length);
    for (let head = 0; head < width; head += size) {
      for (let t = 0; t < count; t++) {
        const row = q.subarray(t * width + head, t * width + head + size);
        const weights: number[] = [];
        for (let s = 0; s < (all ? count : t + 1); s++) {
          let sum = 0;
          for (let d = 0; d < size; d++) sum += row[d] * k[s * width + head + d];
          weights.push(sum / Math.sqrt(size));
        }
        const peak = Math.max(...weights);
        const powers = weights.map((weight) => Math.exp(weight - peak));
        const total = powers.reduce((a, b) => a + b, 0);
        powers.forEach((power, s) => {
          for (let d = 0; d < size; d++) blended[t * width + head + d] += (power / total) * v[s * width + head + d];
        });
      }
    }
    return this.#linear(blended, count, `${name}out_proj`);
  }

  #linear(x: Float32Array, count: number, name: string): Float32Array<ArrayBuffer> {
    const { data, factors, rows, columns } = this.#get(`${name}.weight`);
    const bias = this.#tensors.get(`${name}.bias`)?.data;
    const out = new Float32Array(count * rows);
    for (let row = 0; row < rows; row++) {
      const weights = data.subarray(row * columns, (row + 1) * columns);
      const factor = factors?.[row] ?? 1;
      for (let t = 0; t < count; t++) {
        let sum = 0;
        for (let d = 0, i = t * columns; d < columns; d++, i++) sum += weights[d] * x[i];
        out[t * rows + row] = sum * factor + (bias ? bias[row] : 0);
      }
    }
    return out;
  }

  #norm(x: Float32Array, name: string): Float32Array {
    const weight = this.#get(`${name}.weight`).data;
    const bias = this.#get(`${name}.bias`).data;
    const width = weight.length;
    const out = new Float32Array(x.length);
    for (let start = 0; start < x.length; start += width) {
      let mean = 0;
      let square = 0;
      for (let d = 0; d < width; d++) mean += x[start + d] / width;
      for (let d = 0; d < width; d++) square += (x[start + d] - mean) ** 2 / width;
      const scale = 1 / Math.sqrt(square + this.#text.epsilon);
      for (let d = 0; d < width; d++) out[start + d] = (x[start + d] - mean) * scale * weight[d] + bias[d];
    }
    return out;
  }

  #get(name: string): Matrix {
    const tensor = this.#tensors.get(name);
    if (!tensor) throw new Error(`the text tower lacks ${name}`);
    return tensor;
  }
}
