// Colors for answers: on the GPU, every splat looks its scores up in a texture, and shows an edit before it is done.

import { SplatMesh, dyno } from "@sparkjsdev/spark";
import * as THREE from "three";

/** Prompts that are painted at once. */
export const MOST_PROMPTS = 6;
/** How an answer is shown: marked in its color, or all scores as a scale of heat. */
export type Mode = "marks" | "heat";

/** One color for each prompt, distinct also for color-blind eyes (Okabe and Ito). */
export const COLORS = ["#ff8c1a", "#3fa7ff", "#19c38f", "#e65fae", "#f0e442", "#b48cff"];

export const CHANGES = ["delete", "keep", "recolor", "move", "duplicate"] as const;
export type Change = (typeof CHANGES)[number];

/** An edit as it would look; lengths and directions in the axes of the scene. */
export interface Preview {
  change: Change;
  splats: number[];
  color: string;
  /** Mean brightness of the splats, which a new color keeps. */
  light: number;
  by: THREE.Vector3;
  pivot: THREE.Vector3;
  turn: THREE.Quaternion;
  scale: number;
}

const WIDTH = 2048;
/** The bit of the splats that an edit would change. */
const EDITED = 128;
/** The bit of the splats that are not drawn, because there are too many. */
const LEFT_OUT = 64;

export interface Painted {
  scores: Float32Array;
  /** The splats of the places that were found; null marks all above the threshold. */
  splats: number[] | null;
  threshold: number;
  color: string;
}

const GLSL = `
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
  vec3 lexsplatTurned(vec4 q, vec3 v) {
    return v + 2.0 * cross(q.xyz, cross(q.xyz, v) + q.w * v);
  }
  vec4 lexsplatAfter(vec4 a, vec4 b) {
    return vec4(a.w * b.xyz + b.w * a.xyz + cross(a.xyz, b.xyz), a.w * b.w - dot(a.xyz, b.xyz));
  }
`;

export class Painter {
  readonly #mesh: SplatMesh;
  readonly #layer: number;
  /** The score of every splat for each prompt, in 255ths. */
  readonly #scores: THREE.DataArrayTexture;
  /** Which prompts mark each splat, a bit for each. */
  readonly #masks: THREE.DataTexture;
  /** Color and threshold of each prompt. */
  readonly #prompts: THREE.DataTexture;
  /** Colors that replace those of the scene. */
  readonly #colors: THREE.DataTexture;
  readonly #numbers = {
    count: dyno.dynoInt(0, "lexsplatCount"),
    heat: dyno.dynoBool(false, "lexsplatHeat"),
    colored: dyno.dynoBool(false, "lexsplatColored"),
    /** 0: none, else one more than the place in CHANGES. */
    change: dyno.dynoInt(0, "lexsplatChange"),
    paint: dyno.dynoVec3(new THREE.Vector3(), "lexsplatPaint"),
    by: dyno.dynoVec3(new THREE.Vector3(), "lexsplatBy"),
    pivot: dyno.dynoVec3(new THREE.Vector3(), "lexsplatPivot"),
    turn: dyno.dynoVec4(new THREE.Quaternion(), "lexsplatTurn"),
    scale: dyno.dynoFloat(1, "lexsplatScale"),
  };
  /** What each layer of the scores holds. */
  readonly #held: (Float32Array | null)[] = new Array(MOST_PROMPTS).fill(null);
  readonly #modifier: ReturnType<typeof modifier>;
  #out: Uint8Array | null = null;
  #shown: { answers: Painted[]; preview: Preview | null } = { answers: [], preview: null };

  constructor(mesh: SplatMesh, count: number) {
    this.#mesh = mesh;
    const rows = Math.max(1, Math.ceil(count / WIDTH));
    this.#layer = WIDTH * rows;
    this.#scores = new THREE.DataArrayTexture(new Uint8Array(this.#layer * MOST_PROMPTS), WIDTH, rows, MOST_PROMPTS);
    this.#scores.format = THREE.RedFormat;
    this.#scores.internalFormat = "R8";
    this.#scores.unpackAlignment = 1;
    this.#scores.needsUpdate = true;
    this.#masks = texture(new Uint8Array(this.#layer), WIDTH, rows, THREE.RedIntegerFormat, "R8UI");
    this.#colors = texture(new Uint8Array(4), 1, 1, THREE.RGBAFormat, "RGBA8");
    this.#prompts = new THREE.DataTexture(
      new Float32Array(4 * MOST_PROMPTS), MOST_PROMPTS, 1, THREE.RGBAFormat, THREE.FloatType,
    );
    this.#prompts.needsUpdate = true;
    const uniforms = {
      scores: dyno.dynoSampler2DArray(this.#scores, "lexsplatScores"),
      masks: dyno.dynoUsampler2D(this.#masks, "lexsplatMasks"),
      prompts: dyno.dynoSampler2D(this.#prompts, "lexsplatPrompts"),
      colors: dyno.dynoSampler2D(this.#colors, "lexsplatColors"),
      ...this.#numbers,
    };
    this.#modifier = modifier(uniforms, count);
  }

  /** From now on the mesh is painted. The first picture comes sooner without: software compiles for long. */
  begin(): void {
    if (this.#mesh.objectModifiers) return;
    this.#mesh.objectModifiers = [this.#modifier];
    this.#mesh.updateGenerator();
  }

  /** Do not draw the splats that have a 1 here. */
  leaveOut(out: Uint8Array): void {
    this.begin();
    this.#out = out;
    this.#mask(this.#shown.answers, this.#shown.preview);
    this.#mesh.updateVersion();
  }

  /** Show answers; none shows the scene as it is. Uploads one byte a splat for a new prompt. */
  paint(answers: Painted[], mode: Mode, preview: Preview | null = null): void {
    const bytes = this.#scores.image.data as Uint8Array;
    const prompts = this.#prompts.image.data as Float32Array;
    const color = new THREE.Color();
    answers.slice(0, MOST_PROMPTS).forEach(({ scores, threshold, color: name }, row) => {
      color.set(name).convertLinearToSRGB(); // splats are painted in display values
      prompts.set([color.r, color.g, color.b, threshold], 4 * row);
      if (this.#held[row] === scores) return;
      this.#held[row] = scores;
      const start = row * this.#layer;
      for (let i = 0; i < scores.length; i++) bytes[start + i] = Math.round(scores[i] * 255);
      this.#scores.addLayerUpdate(row);
      this.#scores.needsUpdate = true;
    });
    this.#shown = { answers, preview };
    if (answers.length > 0 || preview) this.begin();
    this.#mask(answers, preview);
    this.#prompts.needsUpdate = true;
    this.#numbers.count.value = Math.min(answers.length, MOST_PROMPTS);
    this.#numbers.heat.value = mode === "heat";
    this.#preview(preview);
    this.#mesh.updateVersion();
  }

  /** Show these colors [N, 3] in place of the scene's; null shows the scene's. */
  recolor(colors: Uint8Array | null): void {
    this.begin();
    this.#numbers.colored.value = colors !== null;
    if (colors) {
      const whole = new Uint8Array(this.#layer * 4);
      for (let i = 0, c = 0; c < colors.length; i += 4, c += 3) whole.set(colors.subarray(c, c + 3), i);
      this.#colors.dispose(); // its size changes
      this.#colors.image = { data: whole, width: WIDTH, height: this.#layer / WIDTH };
      this.#colors.needsUpdate = true;
    }
    this.#mesh.updateVersion();
  }

  #mask(answers: Painted[], preview: Preview | null): void {
    const masks = this.#masks.image.data as Uint8Array;
    masks.fill(0);
    const out = this.#out;
    if (out) for (let i = 0; i < out.length; i++) if (out[i]) masks[i] = LEFT_OUT;
    answers.forEach(({ splats, scores, threshold }, row) => {
      if (splats) for (const splat of splats) masks[splat] |= 1 << row;
      else for (let i = 0; i < scores.length; i++) if (scores[i] >= threshold) masks[i] |= 1 << row;
    });
    for (const splat of preview?.splats ?? []) masks[splat] |= EDITED;
    this.#masks.needsUpdate = true;
  }

  #preview(preview: Preview | null): void {
    const { change, paint, by, pivot, turn, scale } = this.#numbers;
    change.value = preview ? CHANGES.indexOf(preview.change) + 1 : 0;
    if (!preview) return;
    // The modifier works in the axes of the file.
    const back = this.#mesh.quaternion.clone().invert();
    const color = new THREE.Color(preview.color).convertLinearToSRGB();
    paint.value.set(color.r, color.g, color.b).divideScalar(Math.max(preview.light, 0.02));
    by.value.copy(preview.by).applyQuaternion(back);
    pivot.value.copy(preview.pivot).applyQuaternion(back);
    (turn.value as THREE.Quaternion).copy(back).multiply(preview.turn).multiply(this.#mesh.quaternion);
    scale.value = preview.scale;
  }
}

const TYPES = {
  scores: "sampler2DArray", masks: "usampler2D", prompts: "sampler2D", colors: "sampler2D", count: "int", heat: "bool",
  colored: "bool", change: "int", paint: "vec3", by: "vec3", pivot: "vec3", turn: "vec4", scale: "float",
} as const;

function modifier(uniforms: Record<keyof typeof TYPES, unknown>, count: number) {
  const values = uniforms as { [name: string]: dyno.DynoVal<dyno.DynoType> };
  return dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
    const paint = new dyno.Dyno({
      inTypes: { gsplat: dyno.Gsplat, ...TYPES },
      outTypes: { gsplat: dyno.Gsplat },
      globals: () => [GLSL],
      statements: ({ inputs: i, outputs: o }) => dyno.unindentLines(`
        ${o.gsplat} = ${i.gsplat};
        int place = ${i.gsplat}.index;
        bool shown = place >= 0 && place < ${count};
        ivec2 at = shown ? ivec2(place % ${WIDTH}, place / ${WIDTH}) : ivec2(0);
        uint mask = shown ? texelFetch(${i.masks}, at, 0).r : 0u;
        vec3 own = ${i.gsplat}.rgba.rgb;
        if (shown && ${i.colored}) {
          own = texelFetch(${i.colors}, at, 0).rgb;
          ${o.gsplat}.rgba.rgb = own;
        }
        float light = dot(own, vec3(0.2126, 0.7152, 0.0722));
        if (shown && ${i.count} > 0 && ${i.change} == 0) {
          vec3 rest = mix(own, vec3(0.12 + 0.5 * light), 0.75);
          vec3 marked = rest;
          float best = -2.0;
          for (int p = 0; p < ${i.count}; p++) {
            float score = texelFetch(${i.scores}, ivec3(at, p), 0).r;
            vec4 prompt = texelFetch(${i.prompts}, ivec2(p, 0), 0);
            if (${i.heat}) {
              if (score > best) {
                best = score;
                float strength = smoothstep(0.0, 1.0, score / max(0.05, prompt.w + 0.3));
                marked = mix(rest * 0.6, lexsplatHeat(clamp(score, 0.0, 1.0)) * (0.55 + 0.7 * light), 0.15 + 0.75 * strength);
              }
              continue;
            }
            if ((mask & (1u << uint(p))) == 0u) continue;
            float margin = (score - prompt.w) / max(1e-3, 1.0 - prompt.w);
            if (margin > best) {
              best = margin;
              marked = mix(own, prompt.rgb * (0.35 + 0.9 * light), 0.62);
            }
          }
          ${o.gsplat}.rgba.rgb = marked;
        }
        if ((mask & ${LEFT_OUT}u) != 0u) ${o.gsplat}.flags = 0u;
        bool edited = (mask & ${EDITED}u) != 0u;
        if (${i.change} == 1 && edited || ${i.change} == 2 && shown && !edited) ${o.gsplat}.rgba.a = 0.0;
        if (${i.change} == 3 && edited) ${o.gsplat}.rgba.rgb = clamp(${i.paint} * max(light, 0.02), 0.0, 1.0);
        if (${i.change} >= 4 && edited) {
          vec3 offset = ${i.gsplat}.center - ${i.pivot};
          ${o.gsplat}.center = ${i.pivot} + ${i.by} + ${i.scale} * lexsplatTurned(${i.turn}, offset);
          ${o.gsplat}.scales = ${i.gsplat}.scales * ${i.scale};
          ${o.gsplat}.quaternion = lexsplatAfter(${i.turn}, ${i.gsplat}.quaternion);
        }
      `),
    } as ConstructorParameters<typeof dyno.Dyno>[0]);
    return { gsplat: (paint.apply({ gsplat, ...values } as never) as { gsplat: typeof gsplat }).gsplat! };
  });
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
