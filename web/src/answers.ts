// The answers to prompts: how they are found, and their cards beside the picture.

import type { Geometry, Place } from "./geometry";
import { h, iconButton } from "./dom";
import { Dictionary, normalize } from "./dictionary";
import type { Language, Table } from "./language";
import { COLORS } from "./painter";
import { BORDER, type Presence, presenceOf } from "./rules";
import type { Description } from "./tower";

export interface Answer {
  /** What was typed, and the phrase that was looked up. */
  prompt: string;
  phrase: string;
  /** "dictionary" or "text tower": where the table comes from. */
  from: string;
  table: Table;
  scores: Float32Array;
  presence: Presence;
  automatic: number;
  threshold: number;
  color: string;
  /** Shown although the scene does not hold it. */
  anyway: boolean;
  places: Place[] | null;
  /** The place that the camera looks at. */
  place: number;
}

/** What answers prompts: the dictionary, then the text tower. */
export class Answerer {
  constructor(
    readonly dictionary: Dictionary,
    readonly language: Language,
    readonly shown: Uint32Array,
    /** What any phrase means; null where the page has no text tower. */
    readonly tower: ((phrase: string) => Promise<Description | null>) | null,
  ) {}

  /** The answer to a prompt; null if nothing in this page can tell what it means. */
  async answer(prompt: string, color: string): Promise<Answer | null> {
    const known = this.dictionary.find(prompt);
    if (known >= 0) {
      const table = this.dictionary.table(known);
      const scores = this.language.scores(table);
      const phrase = this.dictionary.phrases[known];
      return answered(prompt, phrase, "dictionary", table, scores, this.dictionary.presence(known), color);
    }
    const phrase = normalize(prompt);
    const described = (await this.tower?.(phrase)) ?? null;
    if (!described) return null;
    const { table, heights, best, rule } = described;
    const scores = this.language.scores(table);
    const presence = presenceOf(scores, heights, best, rule, this.language, this.shown);
    return answered(prompt, phrase, "text tower", table, scores, presence, color);
  }
}

function answered(
  prompt: string, phrase: string, from: string, table: Table, scores: Float32Array, presence: Presence, color: string,
): Answer {
  const found = { automatic: BORDER, threshold: BORDER, anyway: false, places: null, place: 0 };
  return { prompt, phrase, from, table, scores, presence, color, ...found };
}

/** The first color that no answer has. */
export function freeColor(answers: Answer[]): string {
  return COLORS.find((color) => !answers.some((answer) => answer.color === color)) ?? COLORS[0];
}

/** Whether an answer is painted: a thing that is not here is not, unless the visitor wants to see the best guess. */
export function painted(answer: Answer): boolean {
  return answer.presence !== "no" || answer.anyway;
}

/** The places of an answer; they are found once for each threshold. */
export function placesOf(answer: Answer, geometry: Geometry): Place[] {
  answer.places ??= painted(answer) ? geometry.places(answer.scores, answer.threshold) : [];
  return answer.places;
}

/** What an answer says, in words. */
export function spoken(answer: Answer): string {
  if (answer.presence === "no") return "not in this scene";
  const count = answer.places?.length;
  const doubt = answer.presence === "unsure" ? "perhaps " : "";
  if (count === undefined) return `${doubt}here`;
  return count === 0 ? "nothing above the threshold" : `${doubt}here, ${count === 1 ? "one place" : `${count} places`}`;
}

export interface CardHost {
  show(answer: Answer, step: number): void;
  remove(answer: Answer): void;
  /** The threshold or `anyway` changed. */
  changed(answer: Answer): void;
}

/** The card of an answer: what was asked, whether it is here, and controls. */
export function card(answer: Answer, host: CardHost): HTMLElement {
  const count = answer.places?.length ?? 0;
  const swatch = h("span", { class: "swatch", "aria-hidden": "true" });
  swatch.style.background = answer.color;
  const state = h("span", { class: `state ${answer.presence}`, text: spoken(answer) });
  const understood = answer.phrase !== answer.prompt.trim().toLowerCase() && h("span", { class: "understood", text: `as “${answer.phrase}”` });
  const head = h(
    "div",
    { class: "head" },
    swatch,
    h("strong", { text: answer.prompt }),
    understood,
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
  const element = h("li", { class: "card" }, head, row);
  if (painted(answer)) element.append(thresholdRow(answer, host));
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
