// What the folder holds: manifest.json, and reading its files with their checksums.

/** A message for the visitor in one line: what was expected, what was found, what to do. */
export class PageError extends Error {}

export interface FileEntry {
  bytes: number;
  crc32: number;
}

/** An original camera: OpenCV axes, world to camera, row by row. */
export interface ViewEntry {
  name: string;
  width: number;
  height: number;
  focal: [number, number];
  viewmat: number[];
}

/** The constants of lexsplat.queries.everyday and lexsplat.queries.presence, and the peak of the scene. */
export interface EverydayRule {
  border: number;
  steepness: number;
  offset: number;
  peak_share: number;
  peak: number;
  yes: number;
  no: number;
  /** Borders for what is judged at segments, and of "yes" for phrases with a color; words that tell which is which. */
  yes_segment: number;
  yes_colored: number;
  no_segment: number;
  /** "Yes" and "no" for a part where its thing is described, and from which strength it is. */
  yes_part: number;
  no_part: number;
  at_thing: number;
  /** Ratios at which the relevancy of a part is 0.5: over everyday words, and over its thing. */
  border_part: number;
  over_thing: number;
  names: string[];
  qualities: string[];
  colors: string[];
  parts: string[];
  /** The factor by which another part may fit a place better, the names of one part, and the note on a part that is doubtful. */
  rival: number;
  alike: string[][];
  doubtful: string;
  /** Nouns of things that edits have taken away. */
  gone: string[];
}

/** The constants of lexsplat.queries by which surfaces, instances and evidence are found. */
export interface SelectionRule {
  /** Relevancy at the border: the automatic threshold of every prompt. */
  threshold: number;
  /** Largest distance between linked splats, in usual distances to the sixth neighbor. */
  link: number;
  /** A smaller cluster than this share of the largest one's opacity is a speck. */
  smallest_share: number;
  /** Smallest peak of a cluster above the threshold, as a share of the best one's, both in log-odds. */
  convincing: number;
  /** A peak is the mean of this many of the best scores. */
  peak_count: number;
  /** Splats of lower opacity join clusters but do not link them. */
  faint: number;
  /** A splat belongs to the surface of a hit if its depth differs by at most this share. */
  same_surface: number;
  /** A ray that meets less of a surface meets nothing. */
  least_surface: number;
  /** Evidence is the mean of this share of the splats that score best, and of at least this many. */
  evidence_share: number;
  evidence_count: number;
  /** Splats of lower opacity are no evidence. */
  evidence_faint: number;
}

/** The constants of lexsplat.queries.segments. */
export interface SegmentRule {
  /** A cut is above this share of the best segment's score. */
  lowest: number;
  /** Levels whose taken segments lie below this do not compete. */
  border: number;
  /** A segment of the lowest level that is left scores higher than this share of what is taken, or it stays left. */
  better: number;
  /** Such segments are taken if they weigh at least this share of what is taken, and no more than it does. */
  enough: number;
  /** Share of a splat's own relevancy in its score; the rest is its segment's. */
  own_share: number;
  steepness: number;
  /** Largest factor of an own relevancy for the agreement of the views. */
  most_certain: number;
  /** Factor that keeps the scores of segments that are left below the threshold in single precision. */
  below: number;
  /** Smallest score of a splat in a taken segment. */
  threshold: number;
}

/** The constants of lexsplat.queries.parts. */
export interface PartRule {
  /** A part without a thing is that of each object that has this share of what its name selects. */
  held: number;
  /** Splats of a thing that can be cut, at least. */
  fewest: number;
  neighbors: number;
  /** Differences of colors and of relevancies at which a link has 1/e of its weight. */
  color: number;
  score: number;
  rounds: number;
  shared: number;
  best: number;
  lowest: number;
  mostly: number;
  /** Where the lowest scores of a thing reach this, all of it is the part. */
  all: number;
  usual: number;
  spread: number;
  /** Places of the border that are tried. */
  first: number;
  last: number;
  steps: number;
  near: number;
  few: number;
  /** Steps of the random walks, and the least share of them that end in the part where it may grow. */
  walked: number;
  nearest: number;
  /** A border that links of this total weight cross is short enough. */
  short: number;
  /** The longest border to grow to, relative to that of the best scores. */
  shorter: number;
  /** Scores in a part start at this share of the way from the border to 1. */
  firm: number;
  outside: number;
}

/** What lexsplat view says of itself: the page asks its server instead of its tables. */
export interface ServerEntry {
  /** Counts the edits; a page that shows an earlier version is told so. */
  version: number;
  steps: string[];
  undone: number;
  examples: string[];
  vocabulary: string[];
  formats: string[];
  modes: string[];
}

/** Patterns of Python as sources of regular expressions that ignore case, and words (lexsplat.scenes.publishing.grammar). */
export interface GrammarEntry {
  patterns: Record<string, string>;
  replaced: Record<"contractions" | "reworded" | "frames", [string, string][]>;
  words: Record<string, string[]>;
  materials: Record<string, string>;
}

export interface ObjectEntry {
  name: string;
  center: [number, number, number];
  size: [number, number, number];
  /** Color words, the most frequent first; only in pages without a server. */
  colors?: string[];
  /** Every color that it is seen in. */
  seen_colors?: string[];
  /** Nouns of its likeliest names. */
  nouns?: string[];
}

export interface Manifest {
  format: "lexsplat-page";
  format_version: number;
  lexsplat: string;
  title: string;
  description: string;
  scene: {
    file: string;
    gaussians: number;
    /** Gaussians of the scene; fewer may be in the file. */
    of: number;
    /** Gaussians that are drawn at once, at most. */
    budget: number;
    /** Quaternion xyzw from the axes of the splat file to those of the scene. */
    rotation: [number, number, number, number];
    antialiased: boolean;
    up: [number, number, number];
    meters_per_unit: number | null;
    start_view: string;
  };
  selection_rule: SelectionRule;
  /** Null where a server answers, as are the table of words and the list of objects. */
  server: ServerEntry | null;
  language: {
    codes: string;
    segments: string | null;
    /** How segments are taken; null without segments. */
    segment_rule: SegmentRule | null;
    /** How parts of things are cut; null without segments. */
    part_rule: PartRule | null;
    objects: string;
    num_codes: number;
    method: string;
  } | null;
  words: {
    phrases: string;
    table: string | null;
    count: number;
    /** The filter of English words, what typing errors may mean, and whether the encoder knows nothing else. */
    english?: { file: string; things: string[]; only: boolean } | null;
    /** Missing where a server answers. */
    rule?: EverydayRule;
  };
  objects: ObjectEntry[] | null;
  /** Places in the list of objects for each kind of things ("toy") that the scene holds; "" is any thing. */
  kinds: Record<string, number[]> | null;
  grammar: GrammarEntry;
  text: {
    weights: string;
    tokenizer: string;
    heads: number;
    activation: string;
    /** Of the layer norms. */
    epsilon: number;
    /** Token that fills texts up, where all tokens see each other; null where they see those before them. */
    padding: number | null;
    templates: string[];
  } | null;
  views: ViewEntry[];
  files: Record<string, FileEntry>;
  licenses: Record<string, string>;
  provenance: Record<string, unknown>;
}

const FORMAT_VERSION = 8;

const isText = (value: unknown): boolean => typeof value === "string";
const isRecord = (value: unknown): boolean => typeof value === "object" && value !== null && !Array.isArray(value);
const areNumbers = (count: number) => (value: unknown): boolean =>
  Array.isArray(value) && value.length === count && value.every(Number.isFinite);
const areTexts = (value: unknown): boolean => Array.isArray(value) && value.every(isText);
const orNull = (check: (value: unknown) => boolean) => (value: unknown): boolean => value === null || check(value);

/** What the page cannot do without: where it is in the manifest, what it is, and how that is seen. */
const FIELDS: [string, string, (value: unknown) => boolean][] = [
  ["title", "a text", isText],
  ["description", "a text", isText],
  ["scene", "an object", isRecord],
  ["scene.file", "a text", isText],
  ["scene.gaussians", "a number", Number.isFinite],
  ["scene.of", "a number", Number.isFinite],
  ["scene.budget", "a number", Number.isFinite],
  ["scene.rotation", "4 numbers", areNumbers(4)],
  ["scene.up", "3 numbers", areNumbers(3)],
  ["scene.meters_per_unit", "a number or null", orNull(Number.isFinite)],
  ["server", "an object or null", orNull(isRecord)],
  ["language", "an object or null", orNull(isRecord)],
  ["words", "an object", isRecord],
  ["words.phrases", "a text", isText],
  ["words.count", "a number", Number.isFinite],
  ["text", "an object or null", orNull(isRecord)],
  ["grammar", "an object", isRecord],
  ["grammar.patterns", "an object", isRecord],
  ["grammar.replaced", "an object", isRecord],
  ["grammar.words", "an object", isRecord],
  ["grammar.materials", "an object", isRecord],
  ["files", "an object", isRecord],
  ["licenses", "an object", isRecord],
  ["views", "a list of cameras", areViews],
];

const SEGMENT_RULE = ["lowest", "border", "better", "enough", "own_share", "steepness", "most_certain", "below", "threshold"];
const PART_RULE = [
  "held", "fewest", "neighbors", "color", "score", "rounds", "shared", "best", "lowest", "mostly", "all", "usual", "spread", "first",
  "last", "steps", "near", "few", "walked", "nearest", "short", "shorter", "firm", "outside",
];
const EVERYDAY_RULE = [
  "border", "steepness", "offset", "peak_share", "peak", "yes", "no", "yes_segment", "yes_colored", "no_segment", "yes_part",
  "no_part", "at_thing", "border_part", "over_thing", "rival",
];
const WORD_LISTS = ["names", "qualities", "colors", "parts", "gone"];
const SELECTION_RULE = [
  "threshold", "link", "smallest_share", "convincing", "peak_count", "faint", "same_surface", "least_surface",
  "evidence_share", "evidence_count", "evidence_faint",
];

/** Whether a record has a number under each name. */
function isRule(value: unknown, names: string[]): boolean {
  return isRecord(value) && names.every((name) => Number.isFinite((value as Record<string, unknown>)[name]));
}

function areViews(value: unknown): boolean {
  const isView = (view: ViewEntry | null): boolean =>
    isRecord(view) && isText(view!.name) && areNumbers(2)([view!.width, view!.height]) && areNumbers(2)(view!.focal) && areNumbers(16)(view!.viewmat);
  return Array.isArray(value) && value.every(isView);
}

/** The first field that a manifest lacks, with what it should be; "" if it is whole. */
function lacking(manifest: Manifest): string {
  const at = (path: string): unknown =>
    path.split(".").reduce<unknown>((owner, name) => (owner as Record<string, unknown> | null | undefined)?.[name], manifest);
  const lack = FIELDS.find(([path, , check]) => !check(at(path)));
  if (lack) return `${lack[1]} in ${lack[0]}`;
  if (!manifest.server && !manifest.language) return "language or a server";
  if (manifest.language?.segments) {
    if (!isRule(manifest.language.segment_rule, SEGMENT_RULE)) return `${SEGMENT_RULE.length} numbers in language.segment_rule`;
    if (!isRule(manifest.language.part_rule, PART_RULE)) return `${PART_RULE.length} numbers in language.part_rule`;
  }
  if (manifest.text || manifest.language?.segments) {
    const rule = manifest.words.rule;
    if (!isRule(rule, EVERYDAY_RULE)) return `${EVERYDAY_RULE.length} numbers in words.rule`;
    if (!WORD_LISTS.every((name) => areTexts(at(`words.rule.${name}`)))) return `lists of ${WORD_LISTS.join(", ")} in words.rule`;
    if (!isText(rule!.doubtful) || !Array.isArray(rule!.alike) || !rule!.alike.every(areTexts)) return "names of parts in words.rule";
  }
  if (!isRule(manifest.selection_rule, SELECTION_RULE)) return `${SELECTION_RULE.length} numbers in selection_rule`;
  return manifest.files[manifest.scene.file] ? "" : `${manifest.scene.file} in files`;
}

/** Where the files are: beside the page, or inside it (`--single-file`). */
export class Files {
  #manifest: Manifest | null = null;

  get inside(): boolean {
    return inside();
  }

  async manifest(): Promise<Manifest> {
    let manifest: Manifest;
    try {
      manifest = JSON.parse(new TextDecoder().decode(await unchecked("manifest.json"))) as Manifest;
    } catch (error) {
      if (error instanceof PageError) throw error;
      throw new PageError("manifest.json: expected JSON, found something else; publish the scene again.");
    }
    if (manifest === null || typeof manifest !== "object") manifest = {} as Manifest;
    if (manifest.format !== "lexsplat-page" || manifest.format_version !== FORMAT_VERSION) {
      throw new PageError(
        `manifest.json: expected version ${FORMAT_VERSION} of a lexsplat page, ` +
          `found ${manifest.format_version}; publish the scene again.`,
      );
    }
    const lack = lacking(manifest);
    if (lack) throw new PageError(`manifest.json: expected ${lack}, found something else; publish the scene again.`);
    return this.take(manifest);
  }

  /** Read the files of this manifest from now on. */
  take(manifest: Manifest): Manifest {
    this.#manifest = manifest;
    return manifest;
  }

  /** A file of the manifest. Damaged files are refused by length and CRC-32. */
  async read(name: string): Promise<Uint8Array<ArrayBuffer>> {
    const entry = this.#manifest?.files[name];
    if (!entry) throw new PageError(`${name}: the manifest does not list it; publish the scene again.`);
    const content = await unchecked(name);
    if (content.length !== entry.bytes || crc32(content) !== entry.crc32) {
      const found = content.length === entry.bytes ? "other content" : `${content.length} bytes`;
      throw new PageError(
        `${name}: expected the ${entry.bytes} bytes that were published, found ${found}; copy the folder again.`,
      );
    }
    return content;
  }
}

function inside(): boolean {
  return document.getElementById("file:manifest.json") !== null;
}

/** A file of the page as it is. */
export async function unchecked(name: string): Promise<Uint8Array<ArrayBuffer>> {
  if (inside()) {
    const element = document.getElementById(`file:${name}`);
    if (!element) throw new PageError(`${name}: not inside this page; publish the scene again.`);
    return decodeBase64(element.textContent ?? "");
  }
  if (location.protocol === "file:") {
    throw new PageError(
      "This page needs a web server, because browsers do not let a file read its neighbors. " +
        "In this folder run: python -m http.server, then open http://localhost:8000. " +
        "Or publish with --single-file.",
    );
  }
  let answer: Response;
  try {
    answer = await fetch(name, { credentials: "same-origin" });
  } catch {
    throw new PageError(`${name}: the server does not answer; reload the page.`);
  }
  if (!answer.ok) throw new PageError(`${name}: the server answered ${answer.status}; copy the folder again.`);
  return new Uint8Array(await answer.arrayBuffer());
}

function decodeBase64(text: string): Uint8Array<ArrayBuffer> {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let k = 0; k < 8; k++) n = n & 1 ? 0xedb88320 ^ (n >>> 1) : n >>> 1;
  return n;
});

/** CRC-32 as of zlib. `crypto.subtle` would need https, which a server in one's own network rarely has. */
export function crc32(bytes: Uint8Array): number {
  let crc = 0xffffffff;
  for (let i = 0; i < bytes.length; i++) crc = CRC_TABLE[(crc ^ bytes[i]) & 255] ^ (crc >>> 8);
  return (crc ^ 0xffffffff) >>> 0;
}
