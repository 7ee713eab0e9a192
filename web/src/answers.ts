// The answers to prompts, and what they say.

import type { Dictionary } from "./dictionary";
import type { Place } from "./geometry";
import { COLORS } from "./painter";
import type { Presence } from "./rules";

export interface Answer {
  /** What was typed, and how it was understood. */
  prompt: string;
  phrase: string;
  /** What was mended or not understood; "" for nothing. */
  note: string;
  /** Whether it has words that nothing here knows: then absence is not certain either. */
  unknown: boolean;
  /** "dictionary", "text tower", "server", or "click" for what was clicked. */
  from: string;
  scores: Float32Array;
  /** Scores of each splat by itself, by which places are compared; null where they are `scores`. */
  own: Float32Array | null;
  presence: Presence;
  automatic: number;
  threshold: number;
  color: string;
  hidden: boolean;
  /** Shown although the scene does not hold it. */
  anyway: boolean;
  places: Place[] | null;
  /** The objects of a kind, which are its places for every threshold; null for other phrases. */
  members: Place[] | null;
  /** The answers that this one joins; null if it is one answer. */
  parts: Answer[] | null;
  /** Words that ask for more than things, which the page does not answer; "" if there are none. */
  beyond: string;
  /** Phrases to ask instead. */
  offers: string[];
  /** The place that the camera looks at. */
  place: number;
  /** What the server was asked. */
  asked: object | null;
}

export type Found = Pick<Answer, "phrase" | "from" | "scores" | "presence" | "threshold"> & Partial<Answer>;

/** An answer as it is first shown. */
export function answered(prompt: string, color: string, found: Found): Answer {
  const fresh = {
    note: "", unknown: false, hidden: false, anyway: false, own: null, places: null, members: null, parts: null, beyond: "",
    offers: [], place: 0, asked: null,
  };
  return { ...fresh, prompt, color, automatic: found.threshold, ...found };
}

/** What a click met: names, the surest first, and where. */
export interface Clicked {
  names: { phrase: string; score: number }[];
  point: [number, number, number];
  /** The clicked object; null where only the server knows it. */
  found: Found | null;
}

/** Who answers: the tables of the page, or the server behind it. */
export interface Source {
  readonly examples: string[];
  readonly dictionary: Dictionary;
  complete(text: string): string[];
  /** The answer to a prompt; null if nothing can tell what it means. */
  answer(prompt: string, color: string): Promise<Answer | null>;
  /** Find the places of an answer, for its threshold. */
  refine(answer: Answer): Promise<void>;
  /** What is at a point of the page; null if nothing is. */
  whatIs(x: number, y: number): Promise<Clicked | null>;
}

/** The first color that no answer has. */
export function freeColor(answers: Answer[]): string {
  return COLORS.find((color) => !answers.some((answer) => answer.color === color)) ?? COLORS[0];
}

/** Whether an answer is painted: a thing that is not here is not, unless the visitor wants to see the best guess. */
export function painted(answer: Answer): boolean {
  return !answer.hidden && !answer.beyond && (answer.presence !== "no" || answer.anyway);
}

/** What an answer says, in words. */
export function spoken(answer: Answer): string {
  if (answer.beyond) return "not answered here";
  if (answer.presence === "no") return answer.unknown ? "not found" : "not in this scene";
  const count = answer.places?.length;
  const doubt = answer.presence === "unsure" ? "perhaps " : "";
  if (count === undefined) return `${doubt}here`;
  if (count === 0 && answer.threshold === answer.automatic) {
    if (answer.unknown && doubt) return "not understood";
    if (/^\((?:no|at most) /.test(answer.phrase)) return "so it is: none here";
  }
  return count === 0 ? "nothing above the threshold" : `${doubt}here, ${count === 1 ? "one place" : `${count} places`}`;
}
