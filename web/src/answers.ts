// The answers to prompts: what they say, and their cards beside the picture.

import { h, iconButton } from "./dom";
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
  /** The place that the camera looks at. */
  place: number;
  /** What the server was asked. */
  asked: object | null;
}

export type Found = Pick<Answer, "phrase" | "from" | "scores" | "presence" | "threshold"> & Partial<Answer>;

/** An answer as it is first shown. */
export function answered(prompt: string, color: string, found: Found): Answer {
  const fresh = { note: "", unknown: false, hidden: false, anyway: false, places: null, members: null, place: 0, asked: null };
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
  return !answer.hidden && (answer.presence !== "no" || answer.anyway);
}

/** What an answer says, in words. */
export function spoken(answer: Answer): string {
  if (answer.presence === "no") return answer.unknown ? "not found" : "not in this scene";
  const count = answer.places?.length;
  const doubt = answer.presence === "unsure" ? "perhaps " : "";
  if (count === undefined) return `${doubt}here`;
  return count === 0 ? "nothing above the threshold" : `${doubt}here, ${count === 1 ? "one place" : `${count} places`}`;
}

export interface CardHost {
  show(answer: Answer, step: number): void;
  remove(answer: Answer): void;
  /** The threshold or `anyway` changed: other splats are meant. */
  changed(answer: Answer): void;
  /** The color or whether it is shown changed. */
  repaint(answer: Answer): void;
  /** What else can be done with an answer; null for nothing. */
  further(answer: Answer): HTMLElement | null;
}

/** The card of an answer: what was asked, whether it is here, and controls. */
export function card(answer: Answer, host: CardHost): HTMLElement {
  const count = answer.places?.length ?? 0;
  const swatch = h("input", {
    type: "color",
    class: "swatch",
    value: answer.color,
    "aria-label": `Color of ${answer.prompt}`,
    oninput: (event: Event) => {
      answer.color = (event.target as HTMLInputElement).value;
      host.repaint(answer);
    },
  });
  const state = h("span", { class: `state ${answer.presence}`, text: spoken(answer) });
  const plain = answer.phrase.replace(/^\((.*)\)$/, "$1").replaceAll('"', "");
  const other = plain.toLowerCase() !== answer.prompt.trim().toLowerCase();
  const understood = other && h("span", { class: "understood", text: `as “${plain}”` });
  const head = h(
    "div",
    { class: "head" },
    swatch,
    h("strong", { text: answer.prompt }),
    understood,
    iconButton(answer.hidden ? "hidden" : "shown", `${answer.hidden ? "Show" : "Hide"} ${answer.prompt}`, () => {
      answer.hidden = !answer.hidden;
      host.repaint(answer);
    }),
    iconButton("close", `Remove ${answer.prompt}`, () => host.remove(answer)),
  );
  const row = h("div", { class: "row" }, state);
  if (count > 0) {
    row.append(
      h("button", { type: "button", text: "Fly there", onclick: () => host.show(answer, 0) }),
      ...(count > 1
        ? [iconButton("next", "Next place", () => host.show(answer, 1)), h("span", { text: `${answer.place + 1} of ${count}` })]
        : []),
    );
  }
  if (answer.presence === "no") {
    const label = answer.anyway ? "Hide the best guess" : "Show the best guess";
    row.append(
      h("button", {
        type: "button",
        text: label,
        onclick: () => {
          answer.anyway = !answer.anyway;
          host.changed(answer);
        },
      }),
    );
  }
  const element = h("li", { class: "card" }, head, row, answer.note !== "" && h("p", { class: "fine", text: answer.note }));
  if (painted(answer)) element.append(thresholdRow(answer, host));
  const further = count > 0 && answer.presence !== "no" ? host.further(answer) : null;
  if (further) element.append(further);
  return element;
}

function thresholdRow(answer: Answer, host: CardHost): HTMLElement {
  const text = h("output", { text: answer.threshold.toFixed(2) });
  const slider = h("input", {
    type: "range",
    min: 0,
    max: 1,
    step: 0.01,
    value: answer.threshold.toFixed(2),
    "aria-label": `Threshold of ${answer.prompt}`,
    oninput: (event: Event) => set(Number((event.target as HTMLInputElement).value)),
  });
  const reset = h("button", { type: "button", text: "Automatic", onclick: () => set(answer.automatic, true) });
  reset.disabled = answer.threshold === answer.automatic;
  const set = (value: number, back = false): void => {
    answer.threshold = value;
    answer.places = null;
    text.textContent = value.toFixed(2);
    reset.disabled = value === answer.automatic;
    if (back) slider.value = value.toFixed(2);
    host.changed(answer);
  };
  return h("div", { class: "row threshold" }, h("span", { text: "Threshold" }), slider, text, reset);
}
