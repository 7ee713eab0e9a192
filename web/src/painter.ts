// Colors for answers: on the GPU, every splat looks its codes up in a table of relevancies.

import { SplatMesh, dyno } from "@sparkjsdev/spark";
import * as THREE from "three";
import type { Language, Table } from "./language";

/** Prompts that are painted at once. */
export const MOST_PROMPTS = 6;
/** How an answer is shown: marked in its color, or all scores as a scale of heat. */
export type Mode = "marks" | "heat";

/** One color for each prompt, distinct also for color-blind eyes (Okabe and Ito). */
export const COLORS = ["#ff8c1a", "#3fa7ff", "#19c38f", "#e65fae", "#f0e442", "#b48cff"];

const WIDTH = 2048;

export interface Painted {
  table: Table;
  /** The splats of the places that were found; null marks all above the threshold. */
  splats: number[] | null;
  threshold: number;
  color: string;
}

const GLSL = `
  vec4 lexsplatShares(vec4 shares) {
    vec3 further = shares.yzw * vec3(0.5, 1.0 / 3.0, 0.25);
    return vec4(max(0.0, shares.x - further.x - further.y - further.z), further);
  }
  // Matplotlib's "inferno" as a polynomial (public domain, M. Zucker).
  vec3 lexsplatHeat(float t) {
    const vec3 c0 = vec3(0.00021894, 0.00165100, -0.01948090);
    const vec3 c1 = vec3(0.10651342, 0.56395644, 3.93271239);
    const vec3 c2 = vec3(11.60249308, -3.97285397, -15.94239411);
    const vec3 c3 = vec3(-41.70399613, 17.43639888, 44.35414520);
    const vec3 c4 = vec3(77.16293570, -33.40235894, -81.80730926);
    const vec3 c5 = vec3(-71.31942824, 32.62606426, 73.20951986);
    const vec3 c6 = vec3(25.13112622, -12.24266895, -23.07032500);
    return c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * (c5 + t * c6)))));
  }
`;

export class Painter {
  readonly #mesh: SplatMesh;
  readonly #lut: THREE.DataTexture;
  readonly #numCodes: number;
  readonly #count = dyno.dynoInt(0, "lexsplatCount");
  readonly #heat = dyno.dynoBool(false, "lexsplatHeat");
  readonly #fade = dyno.dynoFloat(0.75, "lexsplatFade");
  /** Which prompts may mark each splat, a bit for each. */
  readonly #masks: THREE.DataTexture;
  /** Color and threshold of each prompt, in row 0 of a texture. */
  readonly #prompts: THREE.DataTexture;

  constructor(mesh: SplatMesh, language: Language) {
    this.#mesh = mesh;
    this.#numCodes = language.numCodes;
    const rows = Math.max(1, Math.ceil(language.count / WIDTH));
    const codes = texture(padded(language.codes, rows), WIDTH, rows, THREE.RGBAIntegerFormat, "RGBA8UI");
    const shares = texture(padded(language.shares, rows), WIDTH, rows, THREE.RGBAFormat, "RGBA8");
    this.#masks = texture(new Uint8Array(WIDTH * rows).fill(255), WIDTH, rows, THREE.RedIntegerFormat, "R8UI");
    this.#lut = texture(new Uint8Array(256 * MOST_PROMPTS), 256, MOST_PROMPTS, THREE.RedFormat, "R8");
    this.#prompts = new THREE.DataTexture(
      new Float32Array(4 * MOST_PROMPTS), MOST_PROMPTS, 1, THREE.RGBAFormat, THREE.FloatType,
    );
    this.#prompts.needsUpdate = true;
    const uniforms = {
      codes: dyno.dynoUsampler2D(codes, "lexsplatCodes"),
      shares: dyno.dynoSampler2D(shares, "lexsplatShares"),
      masks: dyno.dynoUsampler2D(this.#masks, "lexsplatMasks"),
      lut: dyno.dynoSampler2D(this.#lut, "lexsplatLut"),
      prompts: dyno.dynoSampler2D(this.#prompts, "lexsplatPrompts"),
      count: this.#count,
      heat: this.#heat,
      fade: this.#fade,
    };
    mesh.objectModifiers = [modifier(uniforms, language.count)];
    mesh.updateGenerator();
  }

  /** Show answers; none shows the scene as it is. Uploads a table of 256 entries for each prompt. */
  paint(answers: Painted[], mode: Mode): void {
    const tables = this.#lut.image.data as Uint8Array;
    const prompts = this.#prompts.image.data as Float32Array;
    const color = new THREE.Color();
    answers.slice(0, MOST_PROMPTS).forEach((answer, row) => {
      for (let k = 0; k < this.#numCodes; k++) tables[row * 256 + k] = Math.round(answer.table[k] * 255);
      color.set(answer.color).convertLinearToSRGB(); // splats are painted in display values
      prompts.set([color.r, color.g, color.b, answer.threshold], 4 * row);
    });
    this.#lut.needsUpdate = true;
    this.#mask(answers);
    this.#prompts.needsUpdate = true;
    this.#count.value = Math.min(answers.length, MOST_PROMPTS);
    this.#heat.value = mode === "heat";
    this.#mesh.updateVersion();
  }

  #mask(answers: Painted[]): void {
    const masks = this.#masks.image.data as Uint8Array;
    const open = answers.reduce((bits, { splats }, row) => (splats ? bits : bits | (1 << row)), 0);
    masks.fill(open);
    answers.forEach(({ splats }, row) => {
      for (const splat of splats ?? []) masks[splat] |= 1 << row;
    });
    this.#masks.needsUpdate = true;
  }
}

type Uniforms = Record<"codes" | "shares" | "masks" | "lut" | "prompts" | "count" | "heat" | "fade", dyno.Dyno<never, never>>;

function modifier(uniforms: Record<keyof Uniforms, unknown>, count: number) {
  const values = uniforms as { [name: string]: dyno.DynoVal<dyno.DynoType> };
  return dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
    const paint = new dyno.Dyno({
      inTypes: {
        gsplat: dyno.Gsplat, codes: "usampler2D", shares: "sampler2D", masks: "usampler2D", lut: "sampler2D", prompts: "sampler2D",
        count: "int", heat: "bool", fade: "float",
      },
      outTypes: { gsplat: dyno.Gsplat },
      globals: () => [GLSL],
      statements: ({ inputs: i, outputs: o }) => dyno.unindentLines(`
        ${o.gsplat} = ${i.gsplat};
        int place = ${i.gsplat}.index;
        if (${i.count} > 0 && place >= 0 && place < ${count}) {
          ivec2 at = ivec2(place % ${WIDTH}, place / ${WIDTH});
          uvec4 codes = texelFetch(${i.codes}, at, 0);
          vec4 weights = lexsplatShares(texelFetch(${i.shares}, at, 0));
          uint mask = texelFetch(${i.masks}, at, 0).r;
          vec3 own = ${i.gsplat}.rgba.rgb;
          float light = dot(own, vec3(0.299, 0.587, 0.114));
          vec3 rest = mix(own, vec3(0.12 + 0.5 * light), ${i.fade});
          vec3 marked = rest;
          float best = -1.0;
          for (int p = 0; p < ${i.count}; p++) {
            vec4 relevancies = vec4(
              texelFetch(${i.lut}, ivec2(int(codes.x), p), 0).r, texelFetch(${i.lut}, ivec2(int(codes.y), p), 0).r,
              texelFetch(${i.lut}, ivec2(int(codes.z), p), 0).r, texelFetch(${i.lut}, ivec2(int(codes.w), p), 0).r);
            float score = dot(weights, relevancies);
            vec4 prompt = texelFetch(${i.prompts}, ivec2(p, 0), 0);
            if (${i.heat}) {
              if (score > best) {
                best = score;
                float strength = smoothstep(0.0, 1.0, score / max(0.05, prompt.w + 0.3));
                marked = mix(rest * 0.6, lexsplatHeat(clamp(score, 0.0, 1.0)), 0.15 + 0.75 * strength);
              }
              continue;
            }
            if ((mask & (1u << uint(p))) == 0u) continue;
            float margin = (score - prompt.w) / max(1e-3, 1.0 - prompt.w);
            if (margin >= 0.0 && margin > best) {
              best = margin;
              marked = mix(own, prompt.rgb * (0.35 + 0.9 * light), 0.62);
            }
          }
          ${o.gsplat}.rgba.rgb = marked;
        }
      `),
    } as ConstructorParameters<typeof dyno.Dyno>[0]);
    return { gsplat: (paint.apply({ gsplat, ...values } as never) as { gsplat: typeof gsplat }).gsplat! };
  });
}

function padded(values: Uint8Array, rows: number): Uint8Array<ArrayBuffer> {
  const whole = new Uint8Array(WIDTH * rows * 4);
  whole.set(values);
  return whole;
}

function texture(
  data: Uint8Array<ArrayBuffer>, width: number, height: number, format: THREE.PixelFormat, internal: THREE.PixelFormatGPU,
): THREE.DataTexture {
  const made = new THREE.DataTexture(data, width, height, format, THREE.UnsignedByteType);
  made.internalFormat = internal;
  made.unpackAlignment = 1;
  made.needsUpdate = true;
  return made;
}
