// The search bar: a text box with completions, as the ARIA pattern of a combobox has it.

import { h, icon, iconButton, isTouched } from "./dom";
import { MOST_LETTERS } from "./state";

export interface SearchHost {
  complete(text: string): string[];
  /** Ask; `add` keeps the answers that are there. */
  ask(text: string, add: boolean): void;
}

export class SearchBar {
  readonly element: HTMLElement;
  readonly input: HTMLInputElement;
  readonly #list: HTMLUListElement;
  readonly #host: SearchHost;
  #active = -1;

  constructor(host: SearchHost) {
    this.#host = host;
    this.#list = h("ul", { id: "completions", role: "listbox", "aria-label": "Completions", tabindex: -1, hidden: true });
    this.input = h("input", {
      type: "text",
      name: "q",
      role: "combobox",
      "aria-label": "Search this place with words",
      "aria-controls": "completions",
      "aria-expanded": "false",
      "aria-autocomplete": "list",
      placeholder: "Search this place with words",
      autocomplete: "off",
      autocapitalize: "none",
      spellcheck: "false",
      enterkeyhint: "search",
      maxlength: MOST_LETTERS,
      oninput: () => this.#open(),
      onfocus: () => this.#open(),
      onblur: () => setTimeout(() => document.activeElement !== this.input && this.close(), 150), // it may be back by then
      onkeydown: (event: KeyboardEvent) => this.#key(event),
    });
    this.element = h(
      "form",
      {
        class: "search",
        role: "search",
        onsubmit: (event: Event) => {
          event.preventDefault();
          this.#submit(false);
        },
      },
      icon("search"),
      this.input,
      iconButton("add", "Add to the answers", () => this.#submit(true), "Shift+Enter"),
      this.#list,
    );
  }

  /** Completions are there, also for what was typed before; `example` is a phrase to begin with. */
  suggest(example: string): void {
    if (example) this.input.placeholder = `Search this place: ${example}, …`;
    if (document.activeElement === this.input && this.input.value) this.#open();
  }

  close(): void {
    this.#list.hidden = true;
    this.#active = -1;
    this.input.setAttribute("aria-expanded", "false");
    this.input.removeAttribute("aria-activedescendant");
  }

  #submit(add: boolean): void {
    const options = [...this.#list.children] as HTMLElement[];
    const text = this.#active >= 0 ? (options[this.#active]?.textContent ?? "") : this.input.value;
    this.close();
    if (!text.trim()) return this.input.focus();
    this.input.value = ""; // the answers show what was asked
    if (isTouched()) this.input.blur(); // with it goes the keyboard, which covers the answer
    this.#host.ask(text, add);
  }

  #open(): void {
    const found = this.#host.complete(this.input.value);
    this.#list.replaceChildren(
      ...found.map((phrase, n) =>
        h("li", {
          id: `completion-${n}`,
          role: "option",
          "aria-selected": "false",
          text: phrase,
          onpointerdown: (event: Event) => event.preventDefault(), // the box keeps the focus
          onclick: (event: MouseEvent) => {
            this.#active = n;
            this.#submit(event.shiftKey);
          },
        }),
      ),
    );
    this.#active = -1;
    this.#list.hidden = found.length === 0;
    this.input.setAttribute("aria-expanded", String(found.length > 0));
    this.input.removeAttribute("aria-activedescendant");
  }

  #key(event: KeyboardEvent): void {
    const count = this.#list.children.length;
    if (event.key === "Escape") {
      if (this.#list.hidden) this.input.blur();
      this.close();
    } else if (event.key === "Enter" && event.shiftKey) {
      event.preventDefault();
      this.#submit(true);
    } else if ((event.key === "ArrowDown" || event.key === "ArrowUp") && count > 0) {
      event.preventDefault();
      if (this.#list.hidden) return this.#open();
      const step = event.key === "ArrowDown" ? 1 : -1;
      this.#active = (this.#active + step + count + (this.#active < 0 && step < 0 ? 1 : 0)) % count;
      [...this.#list.children].forEach((option, n) => option.setAttribute("aria-selected", String(n === this.#active)));
      this.input.setAttribute("aria-activedescendant", `completion-${this.#active}`);
      this.#list.children[this.#active].scrollIntoView({ block: "nearest" });
    }
  }
}
