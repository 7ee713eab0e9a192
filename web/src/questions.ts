// What a question asks for: things, their unions and colors, as lexsplat.queries.grammar parses them. Relations,
// orders, numbers and exceptions are recognized, and not answered. tests/scenes/test_page_questions.py compares both.

import { singulars } from "./dictionary";
import { type Grammar, HIDDEN } from "./grammar";

/** A thing to look for; with `color`, the objects of the scene in a color; without `text`, any object. */
export interface Thing {
  text: string;
  color: string;
  /** In quotation marks. */
  exact: boolean;
}

export interface Question {
  /** What is asked for, or all that is named where `beyond` says that it is more than that. */
  things: Thing[];
  /** Whether all of them are asked for, not any. */
  together: boolean;
  /** Words that ask for more than things; "" if there are none. */
  beyond: string;
  /** Words that were not understood; "" if there are none. */
  left: string;
  /** A word for a state, which photos may not tell. */
  state: string;
}

const MOST_PARTS = 40;

/** A text, parsed. */
export function understood(text: string, grammar: Grammar): Question {
  const quoted = [...text.matchAll(/"([^"]*)"/g)].map(([, inside]) => inside);
  let number = 0;
  const plain = text.replaceAll("\0", "").replace(/"[^"]*"/g, () => `\0${number++}\0`).replace(/\s+/g, " ").trim();
  const asked = grammar.inFull(plain.replace(/[?.!\s]+$/, "") || plain);
  const now = grammar.match("yes_or_no", asked) ? grammar.without("moment", asked) : asked;
  const inState = grammar.match("state", now)?.groups;
  const rest = inState?.thing ?? now;
  const parser = new Parser(grammar, grammar.match("yes_or_no", rest) !== null, plain);
  const things = parser.whole(rest);
  const shown = ({ text: hidden, color }: Thing): Thing => {
    const whole = hidden.replace(HIDDEN, (_, n: string) => quoted[Number(n)]).trim();
    return { text: whole, color, exact: whole !== hidden };
  };
  return { things: things.map(shown), together: parser.together, beyond: parser.beyond, left: parser.left, state: inState?.state ?? "" };
}

/** The prompts of a text: one for each thing between commas, or one where the commas belong to a question. */
export function prompts(typed: string, grammar: Grammar): string[] {
  const text = typed.replace(/[“”„‟«»]/g, '"');
  const parts = text.split(",").map((part) => part.trim()).filter(Boolean);
  const joins = (part: string): boolean =>
    /^(?:and not|not|but|or|that|which|who|please|thanks?|thank you|right|correct|yes|no)\b/i.test(part) ||
    part.toLowerCase().split(/\s+/).every((word) => ["and", "or", "is", "it"].includes(word) || grammar.has("qualities", word));
  const single = (text.match(/"/g)?.length ?? 0) > 0 || grammar.match("which_of", text) !== null;
  if (parts.length > 1 && (single || parts.slice(1).some(joins) || /^(?:hey|hi|hello|ok|okay|please|so|well|now)\b/i.test(parts[0]))) return [text.trim()];
  return parts.map((part, n) => (n > 0 ? part.replace(/^(?:and|or)\s+(?=\S)/i, "") : part));
}

/** Recursive descent: what binds loosest is split first. */
class Parser {
  beyond = "";
  left = "";
  #all = true;
  #parts = 0;

  /** `typed` is the text before it is put in other words. */
  constructor(readonly grammar: Grammar, readonly yesOrNo: boolean, readonly typed: string) {}

  get together(): boolean {
    return this.yesOrNo && this.#all;
  }

  whole(asked: string): Thing[] {
    const { grammar } = this;
    if (!/[\p{L}\p{N}]/u.test(asked)) {
      this.left = asked;
      return [];
    }
    const which = grammar.match("which_of", asked);
    if (which) this.#beyond(which.groups!.which);
    const every = grammar.match("all_of", asked);
    if (every) this.#beyond(every[0].split(" ")[1]);
    const only = grammar.match("stated", asked) && grammar.find("only", asked);
    if (only) this.left = only[1];
    const things = (every ? null : this.#ofTwo(asked)) ?? this.#phrase(which ? which.groups!.these : grammar.phrase(asked));
    for (const { text } of things) this.left ||= grammar.leftOver(text.replace(HIDDEN, "thing"));
    if (this.left) this.beyond = ""; // its parts are no things
    return things;
  }

  /** Words that ask for more than things, as they were typed: "at most 0" is made of "is there no". */
  #beyond(words: string): void {
    const said = words.replace(HIDDEN, "").trim();
    const isTyped = this.typed.toLowerCase().includes(said.toLowerCase());
    this.beyond ||= isTyped ? said : (/\b(?:neither|nothing|no|not|any|or (?:fewer|less))\b/i.exec(this.typed)?.[0] ?? said);
  }

  /** "Is A the B?" and "is A closer than B?"; null for another question. */
  #ofTwo(asked: string): Thing[] | null {
    const { grammar } = this;
    const closer = grammar.match("closer", asked)?.groups;
    if (closer) return this.#of(/\b(?:closer|nearer|farther|further)\b/i.exec(asked)![0], closer.one, closer.other, closer.to);
    const is = grammar.match("identity", asked)?.groups;
    return is && grammar.undetermined(`${is.one} `).trim() ? this.#of(is.other, is.one, is.other) : null;
  }

  #phrase(given: string): Thing[] {
    const { grammar } = this;
    let words = given.replace(/^[ ,]+|[ ,]+$/g, "");
    if (this.#parts++ > MOST_PARTS) return [];
    if (grammar.match("viewer", words)) {
      if (!this.beyond) this.left ||= words;
      return [];
    }
    const not = grammar.match("not", words);
    if (not) {
      this.#beyond("not");
      return this.#phrase(words.slice(not[0].length));
    }
    const none = grammar.match("none_of", words);
    if (none) return this.#of(none[0], words.slice(none[0].length));
    const neither = grammar.match("neither", words)?.groups;
    if (neither) return this.#neither(neither);
    words = words.replace(/\s*,\s*(?=(?:that|which|who)\s)/gi, " ");
    const between = grammar.match("between", ` ${words}`);
    if (between) {
      this.#beyond("between");
      return [between[1], between[3], between[4]].filter(Boolean).flatMap((part) => this.#phrase(part));
    }
    const quality = grammar.find("quality", ` ${words}`);
    if (quality && !grammar.find("relation", ` ${words} `.slice(quality.index)) && this.#isQuality(quality[2])) {
      const noun = grammar.undetermined(` ${words}`.slice(0, quality.index).trim());
      if (quality[1]) this.#beyond("not");
      if (grammar.match("pick", noun) || grammar.match("extreme", noun)) this.#beyond(noun.split(" ")[0]);
      if (!quality[1] && this.#namesThings(quality[2])) {
        if (grammar.match("thing_word", noun)) return this.#phrase(quality[2]);
        this.#beyond(quality[0].trim().split(" ").slice(0, 2).join(" "));
        return [...this.#phrase(noun), ...this.#phrase(quality[2])];
      }
      return this.#phrase(quality[1] ? noun : `${quality[2]} ${noun}`);
    }
    return this.#difference(words) ?? this.#union(words) ?? this.#one(words);
  }

  /** Whether words after "that is" describe the noun. */
  #isQuality(words: string): boolean {
    const parts = words.toLowerCase().split(" ");
    const picks = this.grammar.match("pick", parts.at(-1)!);
    return parts.length <= 3 && !["the", "a", "an", "made", "built", "not"].includes(parts[0]) && !picks && !this.grammar.match("near_me", `x ${words}`);
  }

  /** Whether words behind "that are" name things: "toys", "red cars". */
  #namesThings(words: string): boolean {
    const last = words.toLowerCase().split(" ").at(-1)!;
    const known = singulars(last).some((form) => this.grammar.has("names", form) || this.grammar.has("kinds", form));
    return !this.grammar.has("qualities", last) && (known || /[^sui]s$/.test(last));
  }

  /** "Toys that are neither red nor blue", "neither the mug nor the duck". */
  #neither({ noun, one, other }: Record<string, string | undefined>): Thing[] {
    const bare = this.grammar.undetermined(noun ?? "");
    const parts = [one, other].map((part) => (bare ? `${bare} that is ${part}` : part));
    return this.#of("neither", bare, ...parts);
  }

  #difference(words: string): Thing[] | null {
    const found = this.grammar.find("except", ` ${words} `);
    if (!found) return null;
    this.#beyond(found[0]);
    const parts = [` ${words} `.slice(0, found.index), ` ${words} `.slice(found.index + found[0].length)];
    return parts.map((part) => part.trim()).filter(Boolean).flatMap((part) => this.#phrase(part));
  }

  /** "A and B", "A or B", "A, B"; null if it is none of them. */
  #union(words: string): Thing[] | null {
    const { grammar } = this;
    const found = grammar.find("both", ` ${words} `);
    if (!found) return null;
    let one = ` ${words} `.slice(0, found.index).trim();
    const other = ` ${words} `.slice(found.index + found[0].length).trim();
    const joint = found[0].trim().toLowerCase();
    const qualities = other.toLowerCase().split(/[\s,]+(?:and\s)?/);
    if (words.includes(",") && qualities.every((word) => grammar.has("qualities", word))) return this.#phrase(`${other} ${grammar.undetermined(one)}`);
    const described = grammar.undetermined(one).toLowerCase().split(" ");
    if (described.every((word) => grammar.has("colors", word) || grammar.has("patterns", word))) {
      const thing = grammar.undetermined(other).split(" ");
      const noun = thing.slice(Math.max(0, thing.findIndex((word) => !grammar.has("colors", word) && !grammar.has("patterns", word)))).join(" ");
      if (noun !== other) {
        if (joint === "and" && noun !== thing.join(" ") && one === grammar.undetermined(one)) return this.#thing(words); // red and white ball
        one = `${one} ${noun}`; // the red or the yellow ball
      }
    }
    if (joint === "or" || other.includes(" or ")) this.#all = false;
    if (!one || !other) this.left ||= joint;
    one = one.replace(/(?:^|(?<=\s))(?:both|either)\s/gi, "");
    return [...this.#phrase(one), ...this.#phrase(other)];
  }

  /** A phrase without "and" and "but". */
  #one(words: string): Thing[] {
    const { grammar } = this;
    const ofTwo = grammar.match("of_two", words);
    if (ofTwo) {
      this.#beyond(ofTwo.groups!.more);
      return this.#phrase(words.slice(ofTwo[0].length) || "thing");
    }
    const most = grammar.match("at_most", words);
    if (most) return this.#of(most[0], words.slice(most[0].length));
    const theOne = grammar.match("the_one", words);
    let bare = theOne ? `thing ${words.slice(theOne[0].length)}` : words;
    for (let before = ""; before !== bare; ) {
      before = bare;
      const rank = grammar.match("ordinal", bare);
      if (rank) {
        this.#beyond(rank[0]);
        bare = bare.slice(rank[0].length);
      }
      const quantity = grammar.match("quantity", bare);
      if (quantity) {
        if (quantity.groups!.exact || quantity.groups!.more || grammar.number(quantity.groups!.number) > 1) this.#beyond(quantity[0]);
        bare = bare.slice(quantity[0].length);
      }
      bare = grammar.without("determiner", bare);
    }
    const size = grammar.match("size", bare);
    if (size) {
      this.#beyond(size[1]);
      return this.#phrase(bare.slice(size[0].length));
    }
    return this.#place(bare) ?? this.#thing(bare);
  }

  /** What a place or a superlative is said of; null for a thing. */
  #place(words: string): Thing[] | null {
    const { grammar } = this;
    const extreme = grammar.match("extreme", words);
    if (extreme) return this.#of(words.split(" ")[0], extreme[2], extreme[3]);
    const pick = grammar.match("pick", words);
    if (pick) return this.#of(pick[0], words.slice(pick[0].length));
    const corner = grammar.match("corner", ` ${words}`);
    if (corner) return this.#of("corner", corner[1]);
    const part = grammar.match("part", ` ${words}`);
    if (part && !(part[5] && !part[3])) return this.#of(part[4], part[1], part[5]);
    const related = grammar.find("relation", ` ${words} `);
    if (related) {
      const found = this.#related(words, related);
      if (found) return found;
    }
    for (const name of ["near_me", "aside"]) {
      const found = grammar.match(name, ` ${words}`);
      if (found && (found[1].trim() || /^(?:on|at|to) /i.test(words))) return this.#of(found[2], found[1]);
    }
    const last = grammar.find("is_pick", ` ${words}`);
    return last && last.index > 0 ? this.#of(last[0].trim().split(" ").at(-1)!, ` ${words}`.slice(0, last.index)) : null;
  }

  /** Two things in a relation; null if the word of the relation belongs to a thing. */
  #related(words: string, found: RegExpExecArray): Thing[] | null {
    const { grammar } = this;
    const target = ` ${words} `.slice(0, found.index).trim();
    const reference = ` ${words} `.slice(found.index + found[0].length).trim();
    const word = found[0].trim().replace(/^(?:(?:that|which|who)\s)?(?:(?:is|are|was|were|there)\s)+/i, "");
    if (!reference && ` ${target} `.includes(" to ")) return null; // something to sit on
    if (grammar.has("qualities", reference) && /^(?:inside|within|into|in)/i.test(word)) return this.#thing(`${reference} ${target}`);
    if (!reference) {
      this.left ||= word;
      return this.#thing(words);
    }
    if (grammar.match("to_a_side", reference)?.[0] === reference) return null; // mug on the left
    return this.#of(word, target, reference);
  }

  /** What is named beside words that this page does not answer. */
  #of(words: string, ...parts: (string | undefined)[]): Thing[] {
    this.#beyond(words);
    return parts.map((part) => part?.trim()).filter((part) => part !== undefined && part !== "").flatMap((part) => this.#phrase(part!));
  }

  #thing(words: string): Thing[] {
    const { grammar } = this;
    const made = grammar.find("made_of", words);
    if (made && (made[0].includes("made") || grammar.has("qualities", made[1]))) {
      const material = made[1].toLowerCase();
      const noun = words.slice(0, made.index).trim();
      if (grammar.match("thing_word", noun)) return [thing(`something made of ${material}`)];
      return this.#thing(`${grammar.entry.materials[material] ?? material} ${noun}`);
    }
    if (words.toLowerCase() === "all") return [thing("")]; // all but the apple
    const word = grammar.match("thing_word", words);
    if (word) return word[1] ? this.#colored(`something ${word[1]}`) : [thing("")];
    const something = grammar.match("something", words);
    if (something) return this.#colored(`something ${something[1]}`);
    const part = grammar.match("with_part", words);
    if (part && !grammar.has("told_colors", part[1])) return this.#of("with", part[1], part[2]);
    return words ? this.#colored(words) : [];
  }

  /** A thing by its words; "something red" and "red toy" are objects of the scene in a color. */
  #colored(text: string): Thing[] {
    const { grammar } = this;
    const words = text.toLowerCase().split(" ");
    const any = words[0] === "something";
    const said = (any ? words.pop() : words.shift()) ?? "";
    const color = said === "grey" ? "gray" : said;
    const target = words.join(" ");
    if (!grammar.has("told_colors", color)) return [thing(text)];
    if (target === "something") return [{ text: "", color, exact: false }];
    const kind = singulars(target).find((form) => grammar.has("kinds", form));
    return [kind ? { text: kind, color, exact: false } : thing(text)];
  }
}

function thing(text: string): Thing {
  return { text, color: "", exact: false };
}
