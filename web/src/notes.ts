// What the page says under the answers: one line, and phrases to ask instead.

import type { Dictionary } from "./dictionary";
import { h, icon } from "./dom";

export class Notes {
  readonly element = h("div", { class: "status", role: "status", "aria-live": "polite" });
  readonly #sheet: HTMLElement;
  readonly #ask: (phrase: string, add: boolean) => void;

  /** `sheet` holds the notes and gets the class "noted" while there is one. */
  constructor(sheet: HTMLElement, ask: (phrase: string, add: boolean) => void) {
    this.#sheet = sheet;
    this.#ask = ask;
  }

  /** Show a line; an empty one removes it. */
  tell(text: string): void {
    this.element.replaceChildren(text ? h("p", { text }) : "");
    this.#sheet.classList.toggle("noted", Boolean(text));
  }

  /** Only screen readers hear this, and only if nothing is shown. */
  say(text: string): void {
    if (this.element.childElementCount === 0 || this.element.firstElementChild?.className === "spoken") {
      this.element.replaceChildren(h("p", { class: "spoken", text }));
    }
  }

  /** Offer phrases after the line; `add` keeps the answers that are there. */
  offer(phrases: { phrase: string; title?: string }[], add: boolean, before = ""): void {
    if (phrases.length === 0) return;
    const buttons = phrases.map(({ phrase, title }) => h("button", { type: "button", text: phrase, title, onclick: () => this.#ask(phrase, add) }));
    this.element.append(h("p", { class: "examples" }, before, ...buttons));
  }

  /** A prompt that is no phrase of a dictionary; `model` is a text model that is not loaded yet. */
  unknown(prompt: string, dictionary: Dictionary, model: { bytes: number; agreed: () => void } | null): void {
    this.tell(`“${prompt}” is not among the ${dictionary.phrases.length.toLocaleString("en")} phrases of this page.`);
    this.offer(dictionary.similar(prompt).map((phrase) => ({ phrase })), true, "Nearest: ");
    if (!model) return;
    const size = (model.bytes / 1e6).toFixed(0);
    this.append(h("button", { type: "button", text: `Load the text model (${size} MB) to ask anything`, onclick: model.agreed }));
  }

  append(element: HTMLElement): void {
    this.element.append(element);
  }
}

/** The message of an error over the whole page. */
export function failure(text: string): HTMLElement {
  return h("div", { class: "failure", role: "alert" }, icon("close"), h("p", { text }));
}
