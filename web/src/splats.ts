// How splats get onto the screen: Spark orders them, these shaders draw them, many to an instance.

import type { SparkRenderer } from "@sparkjsdev/spark";
import * as THREE from "three";
import { WIDTH } from "./painter";

/**
 * Splats of an instance. Spark has one splat to an instance; software draws each instance on its own, which takes
 * longer than its pixels do, and graphics cards fill their units with few of them.
 */
const BATCH = 128;

/** The projection of Spark's shader for what our splats are: packed, with three axes, without levels of detail. */
export const VERTEX = `
  precision highp float;
  precision highp int;
  precision highp sampler2D;
  precision highp sampler2DArray;
  precision highp usampler2D;
  precision highp usampler2DArray;
  #include <splatDefines>
  uniform vec2 renderSize;
  uniform vec4 renderToViewQuat;
  uniform vec3 renderToViewPos;
  uniform float maxStdDev;
  uniform float maxPixelRadius;
  uniform float minAlpha;
  uniform float preBlurAmount;
  uniform float blurAmount;
  uniform float clipXY;
  uniform int drawnSplats;
  uniform sampler2DArray scores;
  uniform usampler2D masks;
  uniform sampler2D prompts;
  uniform sampler2D colors;
  uniform int prompted;
  uniform bool heat;
  uniform bool colored;
  uniform usampler2D ordering;
  uniform usampler2DArray extSplats;
  out vec4 vRgba;
  out vec2 vSplatUv;
  flat out float adjustedStdDev;

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

  // The color of a splat for the prompts: marked in the color of the one that fits best, or its best score as heat.
  vec3 painted(ivec2 at, vec3 own) {
    uint mask = texelFetch(masks, at, 0).r;
    float light = dot(own, vec3(0.2126, 0.7152, 0.0722));
    vec3 rest = mix(own, vec3(0.12 + 0.5 * light), 0.75);
    vec3 marked = rest;
    float best = -2.0;
    for (int p = 0; p < prompted; p++) {
      float score = texelFetch(scores, ivec3(at, p), 0).r;
      vec4 prompt = texelFetch(prompts, ivec2(p, 0), 0);
      if (heat) {
        if (score > best) {
          best = score;
          float strength = smoothstep(0.0, 1.0, score / max(0.05, prompt.w + 0.3));
          // Of several prompts, each keeps its color.
          vec3 tone = prompted > 1 ? prompt.rgb * (0.15 + 0.85 * score) : lexsplatHeat(clamp(score, 0.0, 1.0));
          marked = mix(rest * 0.6, tone * (0.55 + 0.7 * light), 0.15 + 0.75 * strength);
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
    return marked;
  }

  void main() {
    gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // outside the picture
    int place = gl_InstanceID * ${BATCH} + int(position.z);
    if (place >= drawnSplats) return;
    uint splat = texelFetch(ordering, ivec2((place >> 2) & 4095, place >> 14), 0)[place & 3];
    if (splat == 0xffffffffu) return;
    vec3 center, scales;
    vec4 quaternion, rgba;
    unpackSplatEncoding(
      texelFetch(extSplats, splatTexCoord(int(splat)), 0), center, scales, quaternion, rgba,
      vec4(0.0, 1.0, LN_SCALE_MIN, LN_SCALE_MAX)
    );
    float alpha = min(1.0, 2.0 * rgba.a); // stored by half
    if (alpha < minAlpha) return;

    vec3 seen = quatVec(renderToViewQuat, center) + renderToViewPos;
    if (seen.z >= 0.0) return;
    vec4 clip = projectionMatrix * vec4(seen, 1.0);
    if (abs(clip.z) >= clip.w || max(abs(clip.x), abs(clip.y)) > clipXY * clip.w) return;

    vec2 focal = 0.5 * renderSize * vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
    vec2 along = focal / seen.z;
    mat3 J = mat3(along.x, 0.0, -along.x * seen.x / seen.z, 0.0, along.y, -along.y * seen.y / seen.z, 0.0, 0.0, 0.0);
    mat3 axes = transpose(J) * scaleQuaternionToMatrix(scales, quatQuat(renderToViewQuat, quaternion));
    mat3 spread = axes * transpose(axes);
    float a = spread[0][0] + preBlurAmount;
    float d = spread[1][1] + preBlurAmount;
    float b = spread[0][1];
    float sharp = a * d - b * b;
    a += blurAmount;
    d += blurAmount;
    float area = a * d - b * b;
    alpha *= sqrt(max(0.0, sharp / area));
    if (alpha < minAlpha) return;

    float middle = 0.5 * (a + d);
    float apart = sqrt(max(0.0, middle * middle - area));
    vec2 axis = abs(b) > 0.001 ? normalize(vec2(b, middle + apart - a)) : (a >= d ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
    // Farther out, alpha is less than the least that is drawn.
    adjustedStdDev = min(maxStdDev, sqrt(2.0 * log(alpha / minAlpha)));
    vec2 radii = min(vec2(maxPixelRadius), adjustedStdDev * sqrt(max(vec2(0.0), vec2(middle + apart, middle - apart))));
    vec2 offset = position.x * axis * radii.x + position.y * vec2(axis.y, -axis.x) * radii.y;
    ivec2 at = ivec2(int(splat) % ${WIDTH}, int(splat) / ${WIDTH});
    vec3 own = colored ? texelFetch(colors, at, 0).rgb : rgba.rgb;
    vRgba = vec4(prompted > 0 ? painted(at, own) : own, alpha);
    vSplatUv = position.xy * adjustedStdDev;
    gl_Position = vec4(clip.xy + 2.0 / renderSize * offset * clip.w, clip.zw);
  }
`;

/** Spark's, without what our splats never have (levels of detail, colors to convert): software draws a third faster. */
export const FRAGMENT = `
  precision highp float;
  uniform float minAlpha;
  in vec4 vRgba;
  in vec2 vSplatUv;
  flat in float adjustedStdDev;
  out vec4 fragColor;
  void main() {
    float apart = dot(vSplatUv, vSplatUv);
    float alpha = vRgba.a * exp(-0.5 * apart);
    if (apart > adjustedStdDev * adjustedStdDev || alpha < minAlpha) discard;
    fragColor = vec4(vRgba.rgb * alpha, alpha);
  }
`;

/** Let a renderer draw many splats with each instance; it has the shaders above. */
export function drawInBatches(spark: SparkRenderer, drawnSplats: THREE.IUniform<number>): void {
  const geometry = new THREE.InstancedBufferGeometry();
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]];
  const numbers = Array.from({ length: BATCH }, (_, n) => n);
  const places = numbers.flatMap((n) => corners.flatMap(([x, y]) => [x, y, n]));
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(places), 3));
  geometry.setIndex(numbers.flatMap((n) => [0, 1, 2, 0, 2, 3].map((corner) => 4 * n + corner)));
  spark.geometry.dispose();
  spark.geometry = geometry;
  const before = spark.onBeforeRender.bind(spark);
  spark.onBeforeRender = (...given) => {
    before(...given);
    drawnSplats.value = spark.activeSplats;
    geometry.instanceCount = Math.ceil(spark.activeSplats / BATCH);
  };
}
