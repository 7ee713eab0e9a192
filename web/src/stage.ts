// The picture: three.js, Spark, the camera and its ways to move. Axes and units are those of the scene.

import { SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Place } from "./geometry";
import { type Manifest, PageError, type ViewEntry } from "./manifest";
import type { Paint } from "./painter";
import { FRAGMENT, VERTEX, drawInBatches } from "./splats";

/** Scenes of more splats are stored with less precise centers, to fit into the memory of phones. */
const MOST_PRECISE = 1_500_000;
const FLIGHT_MS = 700;
/** Resolution where software draws, while the camera moves and for the first picture. */
const COARSE = 0.5;
/** Software draws the colors of more splats than this coarsely at first. */
const MANY = 100_000;
/** Splats that software draws, at most: a million would take seconds. */
const SOFTWARE_BUDGET = 250_000;
/** The camera rests when it has not moved for so long. */
const REST_MS = 200;
/** What browsers call renderers without a graphics card. */
const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i;
/** Pictures a second of a video, at most. */
const MOST_RATE = 30;
/** Seconds of the swing between two pictures of a video, at most. */
const LONGEST_STEP = 0.2;

const TYPES: Record<string, SplatFileType> = { spz: SplatFileType.SPZ, ply: SplatFileType.PLY, sog: SplatFileType.PCSOGSZIP };

export class Stage {
  readonly camera = new THREE.PerspectiveCamera(50, 1, 0.01, 1000);
  readonly renderer: THREE.WebGLRenderer;
  readonly scene = new THREE.Scene();
  mesh!: SplatMesh;
  /** Called after the camera moved. */
  onMove: () => void = () => undefined;
  /** Called when the camera rests, and before the first picture. */
  onRest: () => void = () => undefined;
  /** Called after every picture. */
  onDraw: () => void = () => undefined;
  manifest: Manifest;
  /** What the splats are painted with; a painter fills it. */
  readonly paints: Paint = {
    scores: { value: null }, masks: { value: null }, prompts: { value: null }, colors: { value: null },
    prompted: { value: 0 }, heat: { value: false }, colored: { value: false },
  };
  readonly #controls: OrbitControls;
  readonly #spark: SparkRenderer;
  /** Whether there is no graphics card: pictures take long. */
  readonly software: boolean;
  /** Resolves when a picture of the sorted splats is on the screen. */
  readonly shown: Promise<void>;
  #show: () => void = () => undefined;
  #wanted = false;
  #drawing = false;
  #moving = false;
  /** The pose of the last picture, and what waits for the camera to rest. */
  #pose = "";
  #resting: ReturnType<typeof setTimeout> | null = null;
  #recording = false;
  /** Until the first picture. */
  #early = true;
  /** What the last order of the splats was for. */
  #order = "";
  #flight = 0;
  /** The flight that is under way; -1 for none. */
  #flying = -1;
  #bottom = 0;

  constructor(readonly canvas: HTMLCanvasElement, manifest: Manifest) {
    this.manifest = manifest;
    this.shown = new Promise((resolve) => (this.#show = resolve));
    try {
      this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    } catch {
      throw new PageError(
        "This page needs WebGL 2, which this browser does not offer; use a newer browser or allow hardware acceleration.",
      );
    }
    const gl = this.renderer.getContext();
    const told = gl.getExtension("WEBGL_debug_renderer_info");
    this.software = told !== null && SOFTWARE.test(String(gl.getParameter(told.UNMASKED_RENDERER_WEBGL)));
    const { antialiased } = manifest.scene;
    const drawnSplats = { value: 0 };
    this.#spark = new SparkRenderer({
      renderer: this.renderer,
      sortRadial: false, // scenes are trained with splats in the order of depth
      preBlurAmount: antialiased ? 0 : 0.3,
      blurAmount: antialiased ? 0.3 : 0,
      // Spark drops splats whose centers lie outside the picture and cuts large ones. Walls are made of such splats:
      // with its defaults a view of the demo differs from our renderer by 32 dB, with these by 37 dB.
      clipXY: 4,
      maxPixelRadius: 4096,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      extraUniforms: { drawnSplats, ...this.paints },
      depthTest: false, // nothing else is in the scene
      enableLod: false, // would start a worker
      onDirty: () => this.#drawing || this.#sorted(), // what changes while drawing is drawn already
    });
    drawInBatches(this.#spark, drawnSplats);
    this.scene.add(this.#spark);
    this.camera.up.fromArray(manifest.scene.up);
    this.#controls = new OrbitControls(this.camera, canvas);
    this.#controls.enableDamping = !calm();
    this.#controls.dampingFactor = 0.12;
    this.#controls.zoomToCursor = true;
    this.#controls.addEventListener("change", () => {
      this.#moving = true;
      this.draw();
      this.onMove();
    });
    this.#controls.addEventListener("start", () => this.#flight++); // the visitor's hand stops a flight
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  async load(content: Uint8Array<ArrayBuffer>): Promise<void> {
    const { file, rotation, gaussians } = this.manifest.scene;
    if (this.mesh) {
      this.scene.remove(this.mesh);
      this.mesh.dispose();
    }
    this.mesh = new SplatMesh({
      fileBytes: content,
      fileType: TYPES[file.split(".").at(-1)!],
      extSplats: gaussians <= MOST_PRECISE,
      raycastable: false,
      lod: false,
    });
    this.mesh.quaternion.set(...rotation);
    await this.mesh.initialized;
    this.#pose = "";
    this.resize();
    this.scene.add(this.mesh);
  }

  /** Spark sorts again also for new colors: the picture in the old order is then right already. */
  #sorted(): void {
    const { sortedCenter, sortedDir } = this.#spark; // the camera may be elsewhere by now
    const order = [this.mesh?.uuid, ...sortedCenter, ...sortedDir].join();
    if (order !== this.#order) this.draw();
    this.#order = order;
  }

  /** Draw soon. Nothing is drawn while nothing changes. `moved` tells that splats moved or appeared. */
  draw(moved = false): void {
    if (moved) this.#order = "";
    if (this.#wanted || !this.mesh?.isInitialized) return;
    this.#wanted = true;
    requestAnimationFrame(() => this.#render());
  }

  #render(): void {
    this.#wanted = false;
    // Not in every picture: rounding moves the camera a bit each time, and Spark then computes and sorts all splats again.
    if (this.#moving) this.#controls.update(); // it tells if the camera goes on to glide
    this.#moving &&= this.#wanted;
    this.#fit();
    this.#drawing = true;
    this.renderer.render(this.scene, this.camera);
    this.#drawing = false;
    if (this.#early && this.#spark.activeSplats > 0) {
      this.#early = false;
      void this.#presented().then(this.#show);
    }
    this.onDraw();
  }

  /** Resolves when what was drawn is on the screen: the browser shows it with its next frame. */
  async #presented(): Promise<void> {
    await this.#drawn();
    for (let frame = 0; frame < 2; frame++) await new Promise(requestAnimationFrame);
  }

  /** Choose the resolution: software draws the first picture and those of a moving camera coarsely, others sharply. */
  #fit(): void {
    this.camera.updateMatrixWorld();
    const pose = [...this.camera.matrixWorld.elements, this.camera.fov].join();
    if (this.#pose === "") this.onRest();
    if (pose !== this.#pose) {
      this.#pose = pose;
      this.#wait(() => this.onRest());
    }
    const coarse = this.software && this.#resting !== null && !this.#recording;
    const ratio = Math.min(devicePixelRatio, 2) * (coarse ? COARSE : 1);
    if (ratio !== this.renderer.getPixelRatio()) this.renderer.setPixelRatio(ratio);
  }

  /** Do something once the camera rests, and draw sharply. */
  #wait(then: () => void): void {
    clearTimeout(this.#resting ?? 0);
    const timer = setTimeout(async () => {
      await this.shown;
      if (timer !== this.#resting) return;
      this.#resting = null;
      then();
      this.draw();
    }, REST_MS);
    this.#resting = timer;
  }

  /** Draw new colors soon: where software draws many splats, coarsely at first. */
  paint(moved: boolean): void {
    if (this.software && this.drawn > MANY && !this.#resting) this.#wait(() => undefined);
    this.draw(moved);
  }

  /** Resolves when what was drawn is done. */
  async #drawn(): Promise<void> {
    const gl = this.renderer.getContext() as WebGL2RenderingContext;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (fence && gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.UNSIGNALED) await new Promise((resolve) => setTimeout(resolve, 5));
    gl.deleteSync(fence);
  }

  resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    // What covers the bottom of the picture on phones moves its middle up.
    if (this.#bottom > 0) this.camera.setViewOffset(width, height, 0, this.#bottom / 2, width, height);
    else this.camera.clearViewOffset();
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  /** Pixels at the bottom that a sheet covers. */
  set covered(pixels: number) {
    if (pixels === this.#bottom) return;
    this.#bottom = pixels;
    this.resize();
  }

  /** Number of splats that are drawn well at once, at most. */
  get budget(): number {
    return this.software ? SOFTWARE_BUDGET : Infinity;
  }

  /** Number of splats of the last picture. */
  get drawn(): number {
    return this.#spark.activeSplats;
  }

  set background(color: string) {
    this.scene.background = new THREE.Color(color);
    this.draw();
  }

  get target(): THREE.Vector3 {
    return this.#controls.target;
  }

  /** The ray through a point of the page. */
  ray(x: number, y: number): THREE.Ray {
    const box = this.canvas.getBoundingClientRect();
    const point = new THREE.Vector2(((x - box.left) / box.width) * 2 - 1, 1 - ((y - box.top) / box.height) * 2);
    this.camera.updateMatrixWorld(); // it may have moved since the last picture
    const caster = new THREE.Raycaster();
    caster.setFromCamera(point, this.camera);
    return caster.ray;
  }

  /** The middle of the part of the picture that nothing covers, on the page. */
  get middle(): [number, number] {
    const box = this.canvas.getBoundingClientRect();
    return [box.left + box.width / 2, box.top + (box.height - this.#bottom) / 2];
  }

  /** Where a point of the scene is on the page; null behind the camera. */
  pixel(point: THREE.Vector3): { x: number; y: number } | null {
    this.camera.updateMatrixWorld();
    const seen = point.clone().project(this.camera);
    if (seen.z > 1) return null;
    const box = this.canvas.getBoundingClientRect();
    return { x: box.left + ((seen.x + 1) / 2) * box.width, y: box.top + ((1 - seen.y) / 2) * box.height };
  }

  /** The camera for the server: world to camera with OpenCV axes, row by row; width, height, focal length, center. */
  lens(): { viewmat: number[]; lens: number[] } {
    this.camera.updateMatrixWorld();
    const m = this.camera.matrixWorldInverse.elements; // column by column, OpenGL axes
    const row = (r: number, sign: number): number[] => [0, 1, 2, 3].map((column) => sign * m[4 * column + r]);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const focal = height / 2 / Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2));
    return {
      viewmat: [...row(0, 1), ...row(1, -1), ...row(2, -1), 0, 0, 0, 1],
      lens: [width, height, focal, width / 2, height / 2 - this.#bottom / 2],
    };
  }

  /** Swing around the target and back, as a video; null where the browser records none. */
  async record(seconds = 6, degrees = 30): Promise<{ video: Blob; suffix: string } | null> {
    const kinds = ["video/mp4;codecs=avc1.42E01E", "video/webm;codecs=vp9", "video/webm"];
    const kind = globalThis.MediaRecorder && kinds.find((one) => MediaRecorder.isTypeSupported(one));
    if (!kind) return null;
    const recorder = new MediaRecorder(this.canvas.captureStream(MOST_RATE), { mimeType: kind, videoBitsPerSecond: 8e6 });
    const parts: Blob[] = [];
    recorder.ondataavailable = ({ data }) => parts.push(data);
    const stopped = new Promise((resolve) => (recorder.onstop = recorder.onerror = resolve));
    const offset = this.camera.position.clone().sub(this.target);
    const flight = ++this.#flight;
    recorder.start();
    this.#recording = true; // the size of a video cannot change
    // Where pictures take long, the swing does too: a video of two pictures shows nothing.
    let before = performance.now();
    for (let time = 0; time < seconds && flight === this.#flight; ) {
      const angle = THREE.MathUtils.degToRad(degrees) * Math.sin((2 * Math.PI * time) / seconds);
      this.camera.position.copy(this.target).add(offset.clone().applyAxisAngle(this.camera.up, angle));
      this.#controls.update();
      this.draw();
      await new Promise(requestAnimationFrame);
      const now = performance.now();
      time += Math.min(LONGEST_STEP, (now - before) / 1000);
      before = now;
    }
    if (recorder.state !== "inactive") recorder.stop();
    await stopped;
    this.#recording = false;
    const video = new Blob(parts, { type: kind });
    if (video.size === 0) throw new PageError("The browser recorded no picture; keep this page in front and try again.");
    return { video, suffix: kind.startsWith("video/mp4") ? ".mp4" : ".webm" };
  }

  /** Stand where a photo was taken. `depth` is how far away the scene is there. */
  jump(view: ViewEntry, depth: number, fly = true): void {
    const { position, forward } = pose(view);
    const tall = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight) < view.width / view.height;
    // The photo fits into the window: its width decides in narrow windows, its height in wide ones.
    const half = tall
      ? ((view.width / 2 / view.focal[0]) * this.canvas.clientHeight) / Math.max(1, this.canvas.clientWidth)
      : view.height / 2 / view.focal[1];
    const fov = Math.min(100, THREE.MathUtils.radToDeg(2 * Math.atan(half)));
    void this.fly(position, position.clone().addScaledVector(forward, depth), fly, fov);
  }

  /** Fly to where a place fills a third of the picture, coming from where the nearest photo was taken. */
  flyTo(place: Place, from: THREE.Vector3): void {
    const half = THREE.MathUtils.degToRad(this.camera.fov / 2);
    const wide = Math.min(1, this.camera.aspect);
    const away = from.clone().sub(place.center);
    const distance = Math.max(this.camera.near * 4, Math.min(away.length(), (place.radius * 2.6) / (Math.tan(half) * wide)));
    void this.fly(place.center.clone().addScaledVector(away.normalize(), distance), place.center);
  }

  /** Move the camera; at once where motion is not wanted. */
  async fly(position: THREE.Vector3, target: THREE.Vector3, smooth = true, fov = this.camera.fov): Promise<void> {
    const flight = ++this.#flight;
    const from = { position: this.camera.position.clone(), target: this.target.clone(), fov: this.camera.fov };
    const start = performance.now();
    this.#flying = flight;
    for (let share = 0; share < 1; ) {
      share = smooth && !calm() ? Math.min(1, (performance.now() - start) / FLIGHT_MS) : 1;
      const eased = share * share * (3 - 2 * share);
      this.camera.position.lerpVectors(from.position, position, eased);
      this.target.lerpVectors(from.target, target, eased);
      this.camera.fov = from.fov + (fov - from.fov) * eased;
      this.camera.updateProjectionMatrix();
      this.#controls.update();
      this.draw();
      if (share < 1) await new Promise(requestAnimationFrame);
      if (flight !== this.#flight) return;
    }
    this.#flying = -1;
    this.onMove();
  }

  /** Turn, shift or approach with the keyboard. */
  key(name: string, shift: boolean): boolean {
    const offset = this.camera.position.clone().sub(this.target);
    const right = new THREE.Vector3().crossVectors(this.camera.up, offset).normalize();
    const step = offset.length() * 0.06;
    const sideways = { ArrowLeft: -1, ArrowRight: 1 }[name];
    const upward = { ArrowUp: 1, ArrowDown: -1 }[name];
    if (name === "+" || name === "=") offset.multiplyScalar(0.88);
    else if (name === "-") offset.multiplyScalar(1.14);
    else if (sideways && shift) this.target.addScaledVector(right, sideways * step);
    else if (upward && shift) this.target.addScaledVector(this.camera.up, upward * step);
    else if (sideways) offset.applyAxisAngle(this.camera.up, sideways * 0.09);
    else if (upward) {
      const angle = offset.angleTo(this.camera.up);
      const turned = THREE.MathUtils.clamp(angle - upward * 0.09, 0.05, Math.PI - 0.05);
      offset.applyAxisAngle(right, turned - angle);
    } else return false;
    this.#flight++;
    this.camera.position.copy(this.target).add(offset);
    this.#controls.update();
    this.draw();
    this.onMove();
    return true;
  }

  /** Resolves when the picture shows the latest state: drawn, and the splats sorted for it. */
  async settled(): Promise<void> {
    for (let quiet = 0; quiet < 2; quiet++) {
      await new Promise(requestAnimationFrame);
      const { sorting, sortDirty } = this.#spark;
      if (this.#wanted || this.#resting || sorting || sortDirty || this.#flying === this.#flight) quiet = -1;
    }
    await this.#drawn();
  }

  /** The picture as a PNG. */
  async picture(): Promise<Blob> {
    await this.settled();
    this.renderer.render(this.scene, this.camera); // a canvas can only be read right after it was drawn
    return new Promise((resolve, reject) =>
      this.canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("no picture"))), "image/png"),
    );
  }
}

/** Whether the visitor asked for less motion. */
function calm(): boolean {
  return matchMedia("(prefers-reduced-motion: reduce)").matches;
}

/** Position, forward and up of a view, in the axes of the scene. */
export function pose(view: ViewEntry): { position: THREE.Vector3; forward: THREE.Vector3 } {
  const m = view.viewmat;
  const position = new THREE.Vector3(
    -(m[0] * m[3] + m[4] * m[7] + m[8] * m[11]),
    -(m[1] * m[3] + m[5] * m[7] + m[9] * m[11]),
    -(m[2] * m[3] + m[6] * m[7] + m[10] * m[11]),
  );
  return { position, forward: new THREE.Vector3(m[8], m[9], m[10]).normalize() };
}
