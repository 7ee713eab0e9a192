// The card of an answer: what was asked, whether it is here, and controls. It changes in place, so that what the
// visitor holds (the threshold, the color) stays under the hand.

import { type Answer, painted, spoken } from "./answers";
import { h, icon, iconButton } from "./dom";

export interface CardHost {
  ask(phrase: string): void;
  show(answer: Answer, step: number): void;
  remove(answer: Answer): void;
  /** The threshold or `anyway` changed: other splats are meant. */
  changed(answer: Answer): void;
  /** The color or whether it is shown changed. */
  repaint(answer: Answer): void;
  /** What else can be done with an answer; null for nothing. */
  further(answer: Answer): HTMLElement | null;
  /** What else could be done is gone: nothing of it stays in the picture. */
  closed(): void;
}

export class Card {
  readonly element: HTMLElement;
  readonly #state = h("span", {});
  readonly #fly = h("button", { type: "button", text: "Fly there", onclick: () => this.host.show(this.answer, 0) });
  readonly #next = iconButton("next", "Next place", () => this.host.show(this.answer, 1));
  readonly #number = h("span", {});
  readonly #guess = h("button", { type: "button", onclick: () => this.#toggleGuess() });
  readonly #shown: HTMLButtonElement;
  readonly #swatch: HTMLInputElement;
  readonly #prompt: HTMLElement;
  readonly #understood = h("span", { class: "understood" });
  readonly #note = h("p", { class: "fine" });
  readonly #slider: HTMLInputElement;
  readonly #value = h("output", {});
  readonly #reset = h("button", { type: "button", text: "Automatic", onclick: () => this.#set(this.answer.automatic) });
  readonly #threshold: HTMLElement;
  #further: HTMLElement | null = null;
  /** What `#further` is for. */
  #places: unknown = null;
  #place = -1;

  constructor(readonly answer: Answer, readonly host: CardHost) {
    const { prompt } = answer;
    this.#prompt = h("strong", { text: prompt });
    this.#swatch = h("input", {
      type: "color",
      class: "swatch",
      value: answer.color,
      "aria-label": `Color of ${prompt}`,
      oninput: () => {
        answer.color = this.#swatch.value;
        host.repaint(answer);
      },
    });
    this.#shown = iconButton("shown", `Hide ${prompt}`, () => {
      answer.hidden = !answer.hidden;
      host.repaint(answer);
    });
    const close = iconButton("close", `Remove ${prompt}`, () => host.remove(answer));
    const head = h("div", { class: "head" }, this.#swatch, this.#prompt, this.#shown, close);
    const row = h("div", { class: "row" }, this.#state, this.#fly, this.#next, this.#number, this.#guess);
    const offers = answer.offers.map((text) => h("button", { type: "button", text, onclick: () => host.ask(text) }));
    this.#slider = h("input", {
      type: "range",
      min: 0,
      max: 1,
      step: 0.01,
      "aria-label": `Threshold of ${prompt}`,
      oninput: () => this.#set(Number(this.#slider.value)),
    });
    this.#threshold = h("div", { class: "row threshold" }, h("span", { text: "Threshold" }), this.#slider, this.#value, this.#reset);
    const ask = offers.length > 0 && h("p", { class: "examples" }, "Ask for: ", ...offers);
    this.element = h("li", { class: "card" }, head, row, this.#note, ask, this.#threshold);
    this.update();
  }

  /** Show the answer as it is now. */
  update(): void {
    const { answer } = this;
    const count = answer.places?.length ?? 0;
    this.#state.className = `state ${answer.beyond ? "unsure" : answer.presence}`;
    this.#state.textContent = spoken(answer);
    const plain = answer.phrase.replace(/^\((.*)\)$/, "$1").replaceAll('"', "");
    this.#understood.textContent = `as “${plain}”`;
    if (plain.toLowerCase() === answer.prompt.trim().toLowerCase()) this.#understood.remove();
    else this.#prompt.after(this.#understood);
    this.#shown.replaceChildren(icon(answer.hidden ? "hidden" : "shown"));
    const label = `${answer.hidden ? "Show" : "Hide"} ${answer.prompt}`;
    this.#shown.setAttribute("aria-label", label);
    this.#shown.title = label;
    show(this.#swatch, !answer.beyond);
    show(this.#shown, !answer.beyond);
    show(this.#fly, count > 0);
    show(this.#next, count > 1);
    show(this.#number, count > 1);
    this.#number.textContent = `${answer.place + 1} of ${count}`;
    show(this.#guess, answer.presence === "no");
    this.#guess.textContent = answer.anyway ? "Hide the best guess" : "Show the best guess";
    show(this.#note, answer.note !== "");
    this.#note.textContent = answer.note;
    show(this.#threshold, painted(answer));
    this.#value.textContent = answer.threshold.toFixed(2);
    if (Number(this.#slider.value) !== Number(answer.threshold.toFixed(2))) this.#slider.value = answer.threshold.toFixed(2);
    this.#reset.disabled = answer.threshold === answer.automatic;
    this.#extend(count > 0 && painted(answer) && answer.presence !== "no");
  }

  /** Offer what else can be done with the places as they are now. */
  #extend(wanted: boolean): void {
    const { places, place } = this.answer;
    if (wanted && this.#further && this.#places === places && this.#place === place) return;
    const open = this.#further instanceof HTMLDetailsElement && this.#further.open;
    this.#further?.remove();
    this.#further = wanted ? this.host.further(this.answer) : null;
    [this.#places, this.#place] = [places, place];
    if (this.#further) this.element.append(this.#further);
    if (open) this.host.closed();
  }

  #set(value: number): void {
    this.answer.threshold = value;
    this.answer.places = null;
    this.host.changed(this.answer);
    this.update();
  }

  #toggleGuess(): void {
    this.answer.anyway = !this.answer.anyway;
    this.host.changed(this.answer);
    this.update();
  }
}

/** The cards of the answers, in their order. */
export class Cards {
  readonly element = h("ul", { class: "answers", "aria-label": "Answers" });
  readonly #cards = new Map<Answer, Card>();

  constructor(readonly host: CardHost) {}

  /** Show the answers as they are now; cards that stay are not replaced. */
  update(answers: Answer[]): void {
    for (const [answer, { element }] of this.#cards) {
      if (answers.includes(answer)) continue;
      element.remove();
      this.#cards.delete(answer);
    }
    answers.forEach((answer, n) => {
      const card = this.#cards.get(answer) ?? new Card(answer, this.host);
      this.#cards.set(answer, card);
      card.update();
      if (this.element.children[n] !== card.element) this.element.insertBefore(card.element, this.element.children[n] ?? null);
    });
  }
}

function show(element: HTMLElement, shown: boolean): void {
  element.hidden = !shown;
}
