// Colors for answers: where splats are drawn, each looks its scores up in a texture. A prompt moves no splat, so Spark
// computes and sorts none. An edit that is shown before it is done moves some; they change where Spark computes them.

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

/** Of the textures with a place for each splat. */
export const WIDTH = 2048;
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

/** What the splats' shader paints with, and the textures behind it. */
export interface Paint {
  scores: THREE.IUniform<THREE.DataArrayTexture | null>;
  masks: THREE.IUniform<THREE.DataTexture | null>;
  prompts: THREE.IUniform<THREE.DataTexture | null>;
  colors: THREE.IUniform<THREE.DataTexture | null>;
  prompted: THREE.IUniform<number>;
  heat: THREE.IUniform<boolean>;
  colored: THREE.IUniform<boolean>;
}

const GLSL = `
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

  constructor(mesh: SplatMesh, count: number, readonly paints: Paint) {
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
    paints.scores.value = this.#scores;
    paints.masks.value = this.#masks;
    paints.prompts.value = this.#prompts;
    paints.colors.value = this.#colors;
    paints.prompted.value = 0;
    paints.colored.value = false;
    this.#modifier = modifier({ masks: dyno.dynoUsampler2D(this.#masks, "lexsplatMasks"), ...this.#numbers }, count);
  }

  /** From now on splats move and vanish. Nothing else needs this, and software compiles for long. */
  #change(): void {
    if (!this.#mesh.objectModifiers) {
      this.#mesh.objectModifiers = [this.#modifier];
      this.#mesh.updateGenerator();
    }
    this.#mesh.updateVersion();
  }

  /** Do not draw the splats that have a 1 here. */
  leaveOut(out: Uint8Array): void {
    this.#out = out;
    this.#mask(this.#shown.answers, this.#shown.preview);
    this.#change();
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
    const changed = preview !== null || this.#shown.preview !== null;
    this.#shown = { answers, preview };
    this.#mask(answers, preview);
    this.#prompts.needsUpdate = true;
    this.paints.prompted.value = preview ? 0 : Math.min(answers.length, MOST_PROMPTS);
    this.paints.heat.value = mode === "heat";
    this.#preview(preview);
    if (changed) this.#change();
  }

  /** Show these colors [N, 3] in place of the scene's; null shows the scene's. */
  recolor(colors: Uint8Array | null): void {
    this.paints.colored.value = colors !== null;
    if (colors) {
      const whole = new Uint8Array(this.#layer * 4);
      for (let i = 0, c = 0; c < colors.length; i += 4, c += 3) whole.set(colors.subarray(c, c + 3), i);
      this.#colors.dispose(); // its size changes
      this.#colors.image = { data: whole, width: WIDTH, height: this.#layer / WIDTH };
      this.#colors.needsUpdate = true;
    }
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
  masks: "usampler2D", change: "int", paint: "vec3", by: "vec3", pivot: "vec3", turn: "vec4", scale: "float",
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
        float light = dot(${i.gsplat}.rgba.rgb, vec3(0.2126, 0.7152, 0.0722));
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
