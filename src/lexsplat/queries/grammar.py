"""The grammar of phrases and questions, without a language model.

mug                                  a thing; every word goes to the text encoder
mug on the cloth                     things by their place (`patterns.RELATIONS`)
mug not on the cloth                 all other mugs
mug next to the duck on the table    right-associative: mug next to (duck on the table)
things on it that are not on the mat   by the verb, said of the things (`wording.of_the_first`)
mug between the apple and the duck   also "closest to", "farthest from", "in the back left corner"
toy in front of me                   "me" stands where the view was taken
apple and banana                     the union; also "or" and commas
fruit but not the banana             the difference; also "without", "except", "other than"; "not the mug"
largest toy but the bear             the exception is taken off before the largest is picked
on the table                         a place alone: any object there
mug on the cloth and left of the duck    both places of one thing
isn't the mug on the cloth?          asks what "is the mug on the cloth?" asks
largest book, leftmost mug           one of several
two apples                           all of them, if there are as many; "exactly two", "only one": and no more
second toy from the left             by its place in an order; also "3 nearest things to the mug"
is the bear bigger than the duck?    by boxes; "which is bigger, A or B?" is the largest of both
things at the back of the table      a part of an area; also "in the middle", "at the edge"
mug with a handle                    the mug, if it has one (`having`)
is there an apple and a cat?         both, else nothing; "is everything on the cloth?": all, else nothing
mug that is blue; is the mug blue?   the same as "blue mug"; "made of metal" as well
what is on the cloth?                any object; also "thing", "object", "everything"
red thing, yellow toys               the objects, or those of a kind, in a color
what can I drink from?               the same as "something to drink from"
how many apples are there?           the same as "apple"; plurals are asked for in the singular
where is the mug? show me the mug    the same as "mug" (`_FRAMES`)
"something on wheels"                in quotation marks, straight or curly: one thing, whatever its words

What does not fit or lacks a part is one thing, asked for in its own words, and `Understood.note` says so.
"""

from __future__ import annotations

import re
import string
from dataclasses import replace

from lexsplat.queries import patterns
from lexsplat.queries.having import thing_of, unseen
from lexsplat.queries.phrases import (
    ORDERED,
    Anything,
    AtLeast,
    Between,
    Both,
    Every,
    Except,
    InCorner,
    InPart,
    Phrase,
    Pick,
    Related,
    RelationName,
    Thing,
    Together,
    Understood,
    Viewer,
    among,
    has_stray_viewer,
    in_place_of,
    loosened,
    mended_note,
    numbered,
    of_the_picked,
    parts_of,
    placed,
    things_of,
    with_things,
    without,
)
from lexsplat.queries.questions import (
    as_phrase,
    asks_for_all,
    asks_yes_or_no,
    at_one_moment,
    command_note,
    not_in_answer,
    not_understood,
    says_more,
    states,
    with_asking_words,
    without_state,
)
from lexsplat.queries.rewording import counts_parts, in_full
from lexsplat.queries.spelling import singular, straight_quotes
from lexsplat.queries.statements import neither, stated_of_two
from lexsplat.queries.vocabulary import QUALITIES, SURFACES
from lexsplat.queries.wording import (
    IncompleteError,
    all_qualities,
    counted,
    describes,
    in_own_letters,
    is_place,
    is_quality,
    lacking,
    names_things,
    number,
    of_the_first,
    own_words,
    picked,
    relation_of,
    undetermined,
    unhidden,
)
from lexsplat.runtime.errors import QueryError

MAX_PARTS = 40
"""Limit on the number of parts, and so on the depth of the recursion."""
MAX_LENGTH = 600
"""Characters from which a text is one thing: no phrase of that length has grammar."""


def understand(text: str) -> Understood:
    """A phrase or question, parsed.

    Raises:
        QueryError: If it is empty, lacks a quotation mark, or has too many parts.
    """
    text = straight_quotes(text)
    if len(text) > MAX_LENGTH:
        return Understood(Thing(text.strip()), "too long for grammar: asked for as one thing", True, True)
    if text.count('"') % 2:
        raise QueryError(f"phrase {text!r}", expected="quotation marks in pairs", found="an odd number")
    # Quoted parts are replaced by a character that no pattern contains.
    quoted: list[str] = re.findall(r'"([^"]*)"', text)
    numbers = iter(range(len(quoted)))
    hidden = re.sub(r'"[^"]*"', lambda _: f"\x00{next(numbers)}\x00", text.replace("\x00", ""))
    plain = " ".join(hidden.split()).rstrip("?.!").strip() or text.strip()
    if not plain:
        raise QueryError("phrase", expected="words", found="nothing", remedy='such as "red mug"')
    mended_text, mended = with_asking_words(plain if plain[1:2].isupper() else plain[:1].lower() + plain[1:])
    whole, moment = at_one_moment(in_full(mended_text))
    asked, state = without_state(whole)
    parser = _Parser(text, together=asks_yes_or_no(asked), stated=states(asked))
    unknown, unread = bool(state), False
    try:
        parsed = parser.whole_phrase(asked)
    except IncompleteError as incomplete:
        parsed, unknown, unread = Thing(plain), True, True
        quote = own_words(str(incomplete), plain)
        note = f'not understood ("{quote}"): asked for as one thing, in these words'
    else:
        unlooked = unseen(parsed, plain)
        unknown = unknown or bool(unlooked) or (bool(parser.notes) and parser.stated)  # is the mug big?
        told = (
            mended_note(mended),
            *dict.fromkeys(parser.notes + parser.asides + unlooked),
            command_note(asked),
            not_in_answer(asked),
            state,
            moment,
        )
        note = in_own_letters("; ".join(filter(None, told)), plain)
    shown = with_things(parsed, lambda thing: unhidden(thing, quoted))
    return Understood(shown, note, unknown, unread, counts_parts(mended_text))


class _Parser:
    """Recursive descent parser: the loosest operators are split first."""

    def __init__(self, whole: str, together: bool = False, stated: bool = False) -> None:
        self.whole, self.together, self.stated = whole, together, stated
        self.notes: list[str] = []
        self.asides: list[str] = []

    def whole_phrase(self, asked: str) -> Phrase:
        """A question or a phrase that is complete, and whose things are things.

        Raises:
            IncompleteError: If it is not so.
        """
        if not asked.strip(string.punctuation + " "):
            raise IncompleteError("")
        parsed = self.question(asked)
        for thing in things_of(parsed):
            if left := not_understood(patterns.HIDDEN.sub("thing", thing)):
                raise IncompleteError(left)
        if has_stray_viewer(parsed):
            raise IncompleteError("me")
        return parsed

    def question(self, asked: str) -> Phrase:
        """A question or a phrase, with the words around the thing."""
        if found := patterns.WHICH_OF.match(asked):
            these = loosened(self.phrase(re.sub(r"\bor\b", "and", found["these"])), together=True)
            if found["near"] or found["far"]:
                to = self.phrase(found["to"] or found["from"] or "me")
                return Related("nearest to" if found["near"] else "farthest from", these, to)
            return Pick(
                patterns.COMPARATIVES[found["more"].lower()] if found["more"] else picked(found), these
            )
        if self.stated and is_place(as_phrase(asked)):  # is on the table
            raise IncompleteError(asked.split()[0])
        if self.stated and (word := says_more(asked)):
            raise IncompleteError(word)
        of_two = stated_of_two(asked, self.phrase) if self.stated and not asks_for_all(asked) else None
        if of_two is not None:
            return loosened(of_two, False)
        parsed = loosened(self.phrase(as_phrase(asked)), self.together)
        if not asks_for_all(asked):
            return of_the_picked(parsed) if self.stated else parsed
        return Every(parsed) if "target" in parts_of(parsed) else Thing(asked)

    def phrase(self, words: str, depth: int = 0) -> Phrase:
        if depth >= MAX_PARTS:
            raise QueryError(
                f"phrase {self.whole[:40]!r}...",
                expected=f"at most {MAX_PARTS} parts",
                found="more",
                remedy="ask for less at once",
            )
        words, deeper = words.strip(" ,"), depth + 1
        if patterns.VIEWER.match(words):
            return Viewer()
        if found := patterns.NOT.match(words):
            return Except(Anything(), self.phrase(words[found.end() :], deeper))
        if found := patterns.NONE_OF.match(words):
            return AtLeast(0, self.phrase(words[found.end() :], deeper), 0)
        if (others := neither(words, lambda part: self.phrase(part, deeper))) is not None:
            return others
        words = re.sub(r"\s*,\s*(?=(?:that|which|who)\s)", " ", words)
        if found := patterns.BETWEEN.match(f" {words}"):
            target, negated, first, second = found.groups()
            things = self.phrase(target or "thing", deeper)
            middle = Between(things, self.phrase(first, deeper), self.phrase(second, deeper))
            return Except(things, middle) if negated else middle
        if found := patterns.QUALITY.search(f" {words}"):
            noun, rest = undetermined(f" {words}"[: found.start()].strip()), found[2]
            if not patterns.RELATION.search(f" {words} "[found.start() :]) and is_quality(rest):
                if (pick := self.picked(noun, rest, found[1], deeper)) is not None:
                    return pick
                if names_things(rest):
                    return among(self.phrase(noun, deeper), self.phrase(rest, deeper), not found[1])
                described = self.phrase(f"{rest} {noun}", deeper)
                return Except(self.phrase(noun, deeper), described) if found[1] else described
        for split in (self.difference, self.union):
            if (joined := split(words, deeper)) is not None:
                return joined
        return self.one(words, deeper)

    def picked(self, noun: str, quality: str, negated: str | None, depth: int) -> Phrase | None:
        """ "Largest toy that is (not) red": one of those; None for a noun without a superlative."""
        pick = self.phrase(noun, depth)
        if not isinstance(pick, (Pick, Related)) or not isinstance(pick.target, (Thing, Anything)):
            return None
        if isinstance(pick, Related) and pick.relation not in ORDERED:
            return None
        name = "thing" if isinstance(pick.target, Anything) else pick.target.text
        described = self.phrase(f"{quality} {name}", depth)
        return replace(pick, target=Except(pick.target, described) if negated else described)

    def difference(self, words: str, depth: int) -> Phrase | None:
        """ "A but not B"; None for another phrase. "Toys but not the largest" names toys alone."""
        parts = patterns.EXCEPT.split(f" {words} ", maxsplit=1)
        if len(parts) < 2:
            return None
        if is_place(parts[1]) and patterns.BUT.search(f" {words} "[len(parts[0]) :]):  # but left of the mug
            return self.phrase(f"{parts[0]} and {parts[1]}", depth)
        if patterns.ONLY.match(parts[1]):
            raise IncompleteError(parts[1].split()[0])
        if (named := parts[0].strip()) and parts[1].strip().lower() in ("one", "two"):  # the largest but one
            return Thing(words)
        first = Anything() if not named or patterns.ALL.match(named) else self.phrase(named, depth)
        second = self.phrase(patterns.AND_NOT.sub(" and ", parts[1]), depth)
        if " without " in f" {words.lower()} " and (lacks := lacking(first, second)):
            return lacks
        bare = second if isinstance(second, Pick) and second.target == Anything() else None
        if bare and not patterns.NAMES_THINGS.search(parts[1]):
            second = replace(bare, target=first)
        return without(first, second) or Except(first, second)

    def union(self, words: str, depth: int) -> Phrase | None:
        """ "A and B", "A or B", "A, B"; None for another phrase."""
        parts = patterns.BOTH.split(f" {words} ", maxsplit=1)
        if len(parts) < 2:
            return None
        joint = f" {words} "[len(parts[0]) : -len(parts[1])].strip().lower()
        one, other = parts[0].strip(), parts[1].strip()
        if "," in words and all_qualities(other):  # vase, white
            return self.phrase(f"{other} {undetermined(one)}", depth)
        if (
            describes(one)
            and (noun := re.sub(rf"^(?:{patterns.ADJECTIVES}\s)+", "", undetermined(other))) != other
        ):
            if joint == "and" and noun != undetermined(other) and one == undetermined(one):
                return self.thing(words)  # red and white ball
            one = f"{one} {noun}"  # the red or the yellow ball
        together = joint != "or" and " or " not in other
        shared = re.search(r"\S\s(?:both|either)\s", one, re.IGNORECASE)  # next to both the mug and the lamp
        another = self.together and patterns.INDEFINITE.match(other)  # is there a thing on the mug and a cat
        one = re.sub(r"(?:^|(?<=\s))(?:both|either)\s", "", one)
        first, second = self.phrase(one, depth), self.phrase(other, depth)
        if is_place(other):
            return self.second_place(first, second, joint)
        is_placed = "target" in parts_of(first)
        if isinstance(first, Related) and (
            shared or (first.target == Anything() and not self.stated and not another)
        ):
            return self.second_reference(first, second, joint)
        if self.stated and isinstance(first, Related) and isinstance(second, (Thing, Both, Together)):
            second = replace(first, reference=second)  # is the mug on the table or the cloth?
        elif not is_placed and (self.stated or (self.together and together)):
            first = in_place_of(second, first)  # are the mug and the duck on the table?
        return (Together if together else Both)(first, second)

    def second_place(self, first: Phrase, place: Phrase, joint: str) -> Phrase:
        """ "Mug on the cloth and left of the duck": both of one thing; with "or" one of them."""
        is_placed = isinstance(first, (Related, Between, InCorner, InPart))
        if joint.endswith("or") and isinstance(first, (Related, Between, InCorner, InPart)):
            return Both(first, placed(place, first.target))
        if not is_placed and joint != ",":
            raise IncompleteError(joint)
        return placed(place, first)

    def second_reference(self, first: Related, second: Phrase, joint: str) -> Phrase:
        """ "What is next to the mug and the duck": things next to both. With "on", things on either."""
        if first.relation in ORDERED or not isinstance(second, (Thing, Both, Together)):
            raise IncompleteError(joint)
        one_of = joint.endswith("or") or first.relation in ("on", "inside", "under", "below")
        if one_of or not isinstance(second, Thing):
            return Both(first, replace(first, reference=second))
        return replace(first, target=first, reference=second)

    def one(self, words: str, depth: int) -> Phrase:
        """A phrase without "and" and "but"."""
        if found := patterns.OF_TWO.match(words):
            rest = undetermined(words[found.end() :]) or "thing"
            return Pick(patterns.COMPARATIVES[found["more"].lower()], self.phrase(rest, depth))
        if found := patterns.AT_MOST.match(words):
            most = number(found["number"]) - bool(found["below"])
            if most < 0:
                raise IncompleteError(found["number"])
            return AtLeast(0, self.phrase(words[found.end() :], depth), most)
        bare, quantity, rank, exact = counted(patterns.THE_ONE.sub("thing ", words))
        if quantity > 1 or rank or exact:
            asides = re.match(r"(?:from|to|on|at)\s", bare, re.IGNORECASE)
            target = self.phrase(f"thing {bare}" if asides else bare, depth)
            if ordered := numbered(target, max(quantity, 1), max(rank, 1)):
                return ordered
            limit, is_definite = quantity if exact else None, bool(patterns.DEFINITE.match(words))
            return Thing(words) if rank else AtLeast(quantity, target, limit, is_definite)
        if found := patterns.SIZE.match(bare):
            return self.sized(bare, found, depth)
        place = self.place(bare, depth)
        return place if place is not None else self.thing(bare)

    def sized(self, words: str, found: re.Match[str], depth: int) -> Phrase:
        """ "Small mug on the table": one of several; "small mugs" have no measure."""
        rest = words[found.end() :]
        placed = patterns.RELATION.search(f" {rest} ")
        head = (f" {rest}"[: placed.start()] if placed else rest).strip()
        if singular(head) != head or patterns.SEVERAL.search(head):
            return Thing(f"{found[1]} {head}")
        which = patterns.SIZES[found[1].lower()]
        self.notes.append(f'"{found[1]}" is taken for the {which}')
        return Pick(which, self.phrase(rest, depth))

    def place(self, words: str, depth: int) -> Phrase | None:
        """A phrase with a place or a superlative; None for a thing."""
        if found := patterns.EXTREME.match(words):
            target, reference = self.phrase(found[2], depth), found[3]
            relation: RelationName = "nearest to" if found[1] else "farthest from"
            return Related(relation, target, self.phrase(reference, depth) if reference else Viewer())
        if found := patterns.PICK.match(words):
            return Pick(picked(found), self.phrase(words[found.end() :] or "thing", depth))
        if found := patterns.CORNER.match(f" {words}"):
            return self.corner(found, depth)
        if (found := patterns.PART.match(f" {words}")) and (part := self.part(found, depth)) is not None:
            return part
        words = patterns.MY_SIDE.sub(r"\1 of me", words)
        if found := patterns.RELATION.search(f" {words} "):
            related = self.related(f" {words} ", found, depth)
            if related is not None:
                return related
        for pattern in (patterns.NEAR_ME, patterns.ASIDE):
            found = pattern.match(f" {words}")
            if found and (found[1].strip() or patterns.AT.match(words)):
                target, side = self.phrase(found[1] or "thing", depth), found[2].lower()
                if side in ("left", "right"):
                    return Pick("leftmost" if side == "left" else "rightmost", target)
                return Related(
                    "nearest to" if side in ("nearest", "closest") else "farthest from", target, Viewer()
                )
        if (found := patterns.IS_PICK.search(f" {words}")) and found.start():
            return Pick(picked(found), self.phrase(f" {words}"[: found.start()], depth))
        return None

    def related(self, words: str, found: re.Match[str], depth: int) -> Phrase | None:
        """Two phrases in a relation; None if the word of the relation belongs to a thing."""
        relation = relation_of(found)
        target, reference = words[: found.start()].strip(), words[found.end() :].strip()
        if not reference and (" to " in f" {target} "):  # "something to sit on" has no reference
            return None
        if reference.lower() in QUALITIES and relation == "inside":  # a car in red
            return self.thing(f"{reference} {target}")
        if not reference:
            raise IncompleteError(found[0].strip())
        if patterns.TO_A_SIDE.match(reference):
            return None  # mug on the left
        if (split := of_the_first(relation, reference)) is not None:
            return placed(self.phrase(split[1], depth), self.phrase(f"{target}{found[0]}{split[0]}", depth))
        things = self.phrase(target, depth) if target else Anything()
        related = Related(relation, things, self.phrase(reference, depth))
        return Except(things, related) if found.group("not") else related

    def corner(self, found: re.Match[str], depth: int) -> Phrase:
        target, negated, one, other, of = found.groups()
        if of and not patterns.PLACE.match(of):
            self.asides.append(f'"of {of}" is left out: corners are those of the whole scene')
        along = patterns.CORNER_SIDES.get((one or "").lower(), (one or "").lower())
        name = " ".join(filter(None, (along, (other or "").lower())))
        things = self.phrase(target or "thing", depth)
        corner = InCorner(things, name)  # type: ignore[arg-type]
        return Except(things, corner) if negated else corner

    def part(self, found: re.Match[str], depth: int) -> Phrase | None:
        """Things in a part of an area; None for "in front of the mug" and "at the back of the mug"."""
        target, negated, determined, part, of = found.groups()
        name = patterns.PARTS.get(part.lower(), "middle")
        is_room = not of or patterns.PLACE.match(of) is not None
        is_surface = bool(of) and singular(undetermined(of.lower())).split()[-1] in SURFACES
        if of and (not determined or (name not in ("middle", "edge") and not (is_room or is_surface))):
            return None
        if not of and name in ("left", "right"):  # one of several: the mug on the left side
            return None
        things = self.phrase(target or "thing", depth)
        inside = InPart(things, name) if is_room else InPart(things, name, self.phrase(of, depth))
        return Except(things, inside) if negated else inside

    def thing(self, words: str) -> Phrase:
        if (found := patterns.MADE_OF.search(words)) and (
            "made" in found[0] or found[1].lower() in QUALITIES
        ):
            material = found[1].lower()
            noun = words[: found.start()].strip()
            if patterns.THING_WORD.match(noun):
                return Thing(f"something made of {material}")
            return self.thing(f"{patterns.MATERIAL.get(material, material)} {noun}")
        if found := patterns.THING_WORD.match(words):
            return thing_of(f"something {found[1]}") if found[1] else Anything()
        if found := patterns.SOMETHING.match(words):
            return thing_of(f"something {found[1]}")
        if not words:
            raise IncompleteError("")
        return thing_of(words if " to " in words or not_understood(words) else singular(words), words)
