"""Questions and requests as phrases: removes the words around the thing."""

from __future__ import annotations

import re
from functools import lru_cache

from lexsplat.queries.everyday import everyday_words
from lexsplat.queries.late import late
from lexsplat.queries.leftovers import NUMBERS, ORDINALS, left_over
from lexsplat.queries.rewording import CONTRACTIONS, LARGE, REWORDED
from lexsplat.queries.spelling import frame_errors
from lexsplat.queries.vocabulary import COLORS, QUALITIES, STATES, default_vocabulary

_I = r"(?:i|we|you|one|someone|somebody|anyone|anybody|they|he|she|it)"
_CAN = r"(?:can|could|would|will|may|might|should|do|did|does)"
_ROOM = r"(?:the|this|that|your|my) (?:\w+ )?(?:room|scene|place|picture|photos?|image|view|house|kitchen|office|space|area|environment)"
_FIND = (
    r"(?:(?:show|find|locate|highlight|search|seek|look|detect|identify|see|get|give|bring|fetch|take|go|navigate|"
    r"zoom|focus|tell|describe|grab|let|direct)\b"
    # Words that are nouns as well: "hand me the mug", but "hand on the table".
    r"|(?:hand|point|fly|move|lead|guide|walk|drive|turn|display|list|select|mark|check|pick|spot|name|count)"
    r"(?= (?:me|us|to|at|out|for|up|the|all|every|everything|each|my|any|a|an)\b))"
)
_REQUEST = (
    rf"{_FIND}(?: me| us)?(?: (?:see|know))?(?: (?:around|again|now))?"
    r"(?: in on| in to| on to| over to| out| up| at| to| for| on| towards?| about)?"
)
_HERE = rf"(?:right |over |up |anywhere |somewhere )*(?:here|there|around|anywhere|somewhere|around here|in here|out there|(?:in|inside|of|within) {_ROOM})"

_PLACE = (
    r"(?:(?:not )?(?:on|upon|in|inside|within|at|by|near|under|underneath|beneath|below|above|over|behind|before|"
    r"between|beside|besides|around|alongside|next to|close to|(?:left|right|top|front) of|to the|"
    r"(?:the )?(?:nearest|closest|farthest|furthest)) (?=\S))"
)
_GRASP = r"(?:grasp|grab|grip|hold|lift|take|pick up)"
_SEE = r"(?:see|find|spot|detect|have|notice|recognize)"
_LEAVE = (
    r"(?:leave|left|put|place|placed|keep|kept|store|stored|drop|dropped|lose|lost|forget|forgot|forgotten|"
    r"misplace|misplaced)"
)
_ANY = r"(?:things?|objects?|items?|stuff|ones?)"

_TAIL = late(
    rf"[\s,;]+(?:please|pls|plz|thx|thanks|thank you|for me|for us|right now|at all|exactly|if any|then|{_HERE})$",
    re.IGNORECASE,
)
_ROBOT = r"(?:robot|alexa|siri|cortana|computer|google|assistant)"
_TAG = late(
    rf",\s*(?:right|correct|yes|no|or not|{_ROBOT}|(?:is|are|was|were|does|do) (?:it|they|there)(?: not)?|"
    r"(?:is|are) not (?:it|they|there)|is it not|are they not)$",
    re.IGNORECASE,
)
_MOVES = r"(?:move|turn|drive|go|navigate|walk|fly|run|lead|guide|take)"
_CHANGES = r"(?:delete|remove|erase|hide|clean|push|pull|lift|throw)"
_COMMAND = late(
    rf"^(?:(?:please|plz|hey|ok|okay|now|so|{_ROBOT}|can|could|would|will|you)[\s,:!]+)*"
    rf"({_MOVES}|{_CHANGES}|pick up|grab|bring|fetch|hand|give|carry)\s(?:me |us )?"
    r"(?=(?:back |over |up |down |straight )?(?:to|towards?|around|past|at|the|a|an|my|near|next|behind|in|left|right)\b)",
    re.IGNORECASE,
)
_WHERE_IS_IT = late(
    r"[\s,;]+where (?:is it|are they|did it go|did i (?:leave|put) (?:it|them))$", re.IGNORECASE
)

_FRAMES: tuple[tuple[str, str], ...] = (
    # Courtesies and requests
    (rf"(?:(?:hey|hi|hello|ok|okay) )?{_ROBOT}\s?[,:!]\s?", ""),
    (rf"(?:hey|hi|hello|ok|okay) {_ROBOT} ", ""),
    (rf"(?:please|pls|plz|kindly|just(?! (?:\d|{'|'.join(NUMBERS)})\b)|hey|hi|hello|ok|okay|so|well|now|um+|sorry|excuse me|and|also)[\s,!:]+", ""),
    (rf"{_CAN} {_I} (?:please |kindly |just |ever |possibly |perhaps |maybe )*(?={_FIND}\b)", ""),
    (rf"{_MOVES} (?:around|past) (?=the|a|an|my)", ""),
    (rf"(?:(?:can|could|would|will) you )?{_CHANGES} (?=(?:the|a|an|my|this|that|these|those|all|every)\b)", ""),
    (rf"(?:{_I} (?:want|need|wish|would like|would love|have|am trying|try|am going) (?:you )?to )(?={_FIND}\b)", ""),
    (r"(?:do you know|i wonder|i want to know|i would like to know|any idea|i am asking)(?: about)?[\s,]+(?=where|what|which|how|if)", ""),
    (r"if (?=there (?:is|are)\b)", ""),
    (rf"{_I} (?:am|are|is) (?:looking|searching|hunting) (?:for|at) ", ""),
    (rf"{_I} (?:want|need|would like|would love|miss|am after|am missing|lost|forgot|misplaced|have lost|have misplaced|can ?not find|could not find) ", ""),
    (r"(?:looking for|in search of|searching for|what about|how about|where about) ", ""),
    (rf"{_REQUEST} (?=where|what|which|how|whether|if)", ""),
    (rf"{_REQUEST} (?=\S)", ""),
    (r"(?:whether|if) (?=there|the|a|an|any)", ""),
    # Where
    (rf"(?:where|how) {_CAN} {_I} {_GRASP} (?=(?:the|a|an|my|this|that)\b)", ""),
    (r"where (?:is it|are they)[\s,]+", ""),
    (rf"where(?: else| exactly)? {_CAN} {_I} (?:find|see|get|spot|look for|buy|locate)\s+", ""),
    (rf"where (?:did|have|has|had) {_I} (?:ever |last )?(?:{_LEAVE}|have)\s+", ""),
    (rf"where do {_I} (?:keep|have|store) (?=(?:the|my|our|a|an)\b)", ""),
    (rf"where (?:{_CAN}) {_I} (?!{_LEAVE} (?:the|my|our|this|that|these|those|it|them)\b)(\w+)(?: (.+))?$", "something to @ in"),
    (r"where (?:is|are|was|were) (.+?) at$", r"\1"),
    (rf"where (?:could|might|may|did|does|do) (?!{_I} )(.+?) (?:be|go|live|stand|sit|lie)$", r"\1"),
    (rf"where (?:has|have|had) (?!{_I} )(.+?) (?:gone|been)$", r"\1"),
    (r"where (?:is|are|was|were|has|have) (?!not\b)(?:located |the whereabouts of )?(?=\S)", ""),
    (r"where (?!is not)(.+?) (?:is|are|was|were|(?:might|may|could|can) be)(?: located| standing| lying)?$", r"\1"),
    (r"(?:what (?:is|are) )?(?:the )?(?:locations?|positions?|names?|whereabouts|coordinates|poses?|place|sizes?|heights?|widths?|lengths?|dimensions) of ", ""),
    (r"in which (?:place|corner|spot) (?:is|are) ", ""),
    (r"(?:which|what) (?:place|corner|spot) (?:is|are) (.+?) in$", r"\1"),
    # How many, how large, how far, in which color
    (r"how far (?:away |apart )?(?:is|are) (.+?) (?:away )?(?:from|to) (?!me$|us$|here$)(.+)$", r"\1 and \2"),
    (r"how far apart (?:is|are) (?=.+ and )", ""),
    (r"(?:what (?:is|are) )?(?:the )?distances? (?:between (.+?) and|(?:from|of) (.+?) (?:to|from)) (?!me$|us$|here$)(.+)$", r"\1\2 and \3"),
    (r"(?:what (?:is|are) )?(?:the )?colou?rs? of ", ""),
    (r"(?:what|which) colou?rs? (?:does|do) (.+?) have$", r"\1"),
    (rf"how {LARGE} (?:is|are) (?!.*\bthan\b)", ""),
    (rf"how (?:many|much)(?: of)?(?: the)? ([\w ]+?) (?:is|are) ((?:not )?(?:{'|'.join(sorted(QUALITIES))}))$", r"\1 that are \2"),
    (r"how (?:many|much)(?: of)?(?: the)? (?:different )?", ""),
    (r"count(?: up)?(?: all)?(?: of)?(?: the)? (?=\S)", ""),
    (r"(?:what (?:is|are) )?(?:the )?(?:total )?(?:number|amount|count|quantity) of ", ""),
    # Is there
    (r"(?:(?:is|are|was|were) there|there (?:is|are)) (?:(?:still|already|really|actually|maybe|perhaps) )*", ""),
    (rf"{_CAN} (?:{_I}|{_ROOM}) (?:\w+ )?(?:see|have|find|spot|contain|hold|show|own|know|include|notice|recognize)(?: of)? ", ""),
    (rf"(?:have|has) (?:{_I}|{_ROOM}) (?:got|seen|found|noticed) ", ""),
    (rf"(?:have|has|had|did|do|does)(?: not)? {_I} (?:ever |just |already )?{_LEAVE} ", ""),
    (rf"(?:has|have) (.+?) been (?:seen|found|{_LEAVE})(?= |$)", r"\1"),
    (rf"have {_I} ", ""),
    (r"(?:got|seen|anyone seen) ", ""),
    (r"(?:what|who) (?:does|do|did) ((?:the|my|a|an) .+?) (?:stand|sit|lie|hang|rest|lean) (?=(?:on|near|next to|close to|beside|alongside|in front of|behind)$)", r"what is \1 "),
    (r"(?:does|do|did) (?=.+ (?:stand|sit|lie|hang|rest|have)\b)", ""),
    # What and which
    (r"what (?:is|are) (.+?) (?:made|built) (?:out )?(?:of|from)$", r"\1"),
    (rf"(?:which|what) ([\w ]+?) (?:is|are) (?:the )?({'|'.join(ORDINALS)}|\d+(?:st|nd|rd|th)) (?:one )?(?=from)", r"\2 \1 "),
    (r"(what|which) else ", r"\1 "),
    (rf"(?:what|which) {_CAN} {_I} {_SEE}(?=$| {_PLACE})", "thing"),
    (rf"(?:what|which) ([\w ]+?) {_CAN} {_I} {_SEE}(?=$| {_PLACE})", r"\1"),
    (rf"(?:what|which)(?: {_ANY})? {_CAN} {_I} (?:be used to |use to )?(.+)$", r"something to \1"),
    (rf"(?:which|what) (\w+) {_CAN} {_I} (.+)$", r"\1 to \2"),
    (r"(?:what|which)(?: else)? (?:is|are)(?: (?:there|here|this|that|it|these|those|visible|present))?$", "thing"),
    (rf"what (?:is|are) there to {_SEE}(?=$| {_PLACE})", "thing"),
    (r"what (?:is|are) there (?=\S)", "thing "),
    (rf"(?:what|which|who) (?:is|are) (?:all )?(?:the|that|this|these|those|a|an) ((?:(?!of\b)\w+ ){{0,3}}?{_ANY})\b", r"\1"),
    (rf"(?:what|which|who) (?:is|are) (?:that|this|these|those)(?: there| here)? (?={_PLACE})", "thing "),
    (r"(?:what|which|who) (?:is|are) (?:that|this|these|those) (?=\w+)", ""),
    (r"(?:which|what) (?:one|ones)(?: of (?:the|these|those))? (?=(?:is|are)\b)", "which "),
    (r"(?:which|what) (?:one|ones)? ?of (?:the|these|those|my) ", "which "),
    (r"(?:which|what) (?:color(?:ed)?|colour(?:ed)?|kind of|sort of|type of|kinds of|sorts of|types of) (?=\w)", "which "),
    (r"what (?:is|are) ((?:the|my|a|an) .+?) (?:(?:stand|sitt|ly|rest)ing )?on$", r"thing under \1"),
    (r"what (?:is|are) ((?:the|my|a|an) .+?) (next to|near|close to|beside|alongside)$", r"thing \2 \1"),
    (r"what (?:is|are) ((?:the|my|a|an) .+?) in front of$", r"thing behind \1"),
    (r"what (?:is|are) ((?:the|my|a|an) .+?) behind$", r"thing in front of \1"),
    (r"(?:which|what) (?:is|are) (?:a|an|the|my) (?=(?:\w+ ?){1,3}$)", ""),
    (r"(?:what|which) (?:is|are) (?:the )?(?=(?:\w+st|leftmost|rightmost)\b(?! (?:to|from|away)\b))", ""),
    (r"(?:what|which|who) (?:is|are) ", "thing that is "),
    (r"(?:what|who) (stands?|lies|lie|sits?|hangs?|rests?) ", r"thing that is \1 "),
    (r"what (\w+s) (?!(?:is|are|was|were)\b)(.+)$", r"something that \1 \2"),
    (r"(?:which|what) (.+?) (?:is|are)(?: (?:there|here|visible|present|shown))?$", r"\1"),
    (r"(?:which|what) ([\w ]+?) (is|are) (?=\S)", r"\1 that \2 "),
    (rf"(?:which|what) (?!(?:do|does|did|is|are|was|were|has|have|had|{_CAN})\b)(?=\w+ )", ""),
)  # fmt: skip
_COMPILED = tuple((late("^" + pattern, re.IGNORECASE), instead) for pattern, instead in _FRAMES)
_ADJECTIVE = rf"(?:{'|'.join(sorted(QUALITIES))})"
_LAST_QUALITIES = late(rf"^(.+?) ({_ADJECTIVE}(?:(?:,? and |,? or |, ?| ){_ADJECTIVE})*)$", re.IGNORECASE)
_ARTICLES = late(r"^(?:(?:the|a|an|my|this|that|these|those|your|all|every|each|of) )+", re.IGNORECASE)
_ANY_STATE = (
    rf"(?:(?:(?:switched|turned|plugged|powered) )?(?:on|off)|plugged in|(?:full of|filled with) \w+|working|running|"
    rf"{'|'.join(sorted(STATES))})"
)
_STATE = late(
    rf"^(?:(?:is|are|was|were)(?: there)?|(?:which|what)(?! (?:is|are|was|were|do|does|did) )"
    rf"(?=.* (?:is|are|was|were)(?: not)? {_ANY_STATE}\b)) (?P<thing>.+?)(?: (?:that|which))?(?: (?:is|are|was|were))?"
    rf"(?: not)?(?<! than) (?P<state>{_ANY_STATE})(?:,? (?:and|or) (?:not|{_ANY_STATE}))*$",
    re.IGNORECASE,
)
"""A question on the state of a thing: "is the lamp on?", "which mug is empty or full?"."""
_COUNTED_TAIL = late(
    rf"\s(?:(?:is|are|do|can|could|did|does|would)(?: {_I}| there)?(?: (?:see|find|count|have|spot|get|exist|visible|present|detect))?|exist)$",
    re.IGNORECASE,
)
_IS = late(r"^(?:is|are|was|were) (?=\S)", re.IGNORECASE)
_PURPOSE = late(
    rf"^((?:some|any)?things?|objects?|items?|stuff) (?:that |which )?{_I} (?:can|could|may|might) (.+)$",
    re.IGNORECASE,
)
_LEFT_OVER = late(
    rf"^(?:can(?! (?:of|openers?)\b)|will|may|might|please)(?= \w)|^(?:turn|switch|go|move|walk)$|^something to {_SEE}$|(?<=something ){_ANY}\b.*",
    re.IGNORECASE,
)
"""Words of a question that stay in a thing when no frame takes them off, in addition to those of `leftovers`."""
_HOW_LARGE = late(
    rf"^(?:.*\b)?how {LARGE} (?:is|are) (?!.*\bthan\b)|"
    r"\b(?:sizes?|heights?|widths?|lengths?|dimensions) of\b",
    re.IGNORECASE,
)
_HOW_FAR = late(r"^how far\b|^(?:what (?:is|are) )?(?:the )?distances? (?:between|from|of)\b", re.IGNORECASE)
_HOW_TO_GRASP = late(rf"^(?:where|how) {_CAN} {_I} {_GRASP}\b", re.IGNORECASE)
_WHICH_COLOR = late(
    r"^(?:of )?(?:what|which) colou?rs?\b.*\b(?:is|are|has|have)\b|^(?:what (?:is|are) )?(?:the )?colou?rs? of\b",
    re.IGNORECASE,
)
_YES_OR_NO = late(
    r"^(?:(?:please|hey|hi|so|well|ok|okay|tell me|check)[\s,]+)*(?:if |whether )?"
    r"(?:(?:is|are|was|were|do|does|did|have|has|can|could)\b|there (?:is|are)\b)"
    rf"(?! {_I} (?:please |kindly |just )?(?!find|see|spot|detect|locate){_FIND})|.*\b(?:whether|if) (?=there|the|a|an|any)\b",
    re.IGNORECASE,
)
_STATED = late(r"^(?:is|are|was|were|do|does|did) (?!there\b|you\b|i\b|we\b)", re.IGNORECASE)
_MOMENT = late(r"\s(still(?! life)|already|currently|presently|again|now|yet|anymore)(?=\s|$)", re.IGNORECASE)
_ONLY = late(
    rf"(?<!\bthe )\b(only|just|merely|solely) (?!(?:\d|(?:{'|'.join(NUMBERS)})\b)|{_PLACE})", re.IGNORECASE
)
_PICKED = late(
    r"\b(?:(?:larg|bigg|small|tini|tall|short|high|low|wid|long|near|clos|farth|furth)est|(?:left|right)most)\b",
    re.IGNORECASE,
)
_PLACED = late(rf"\b{_PLACE}", re.IGNORECASE)
_ALL_OF = late(
    r"^(?:is|are|was|were|do|does|did) (?:all(?: of)?(?: the| my| these| those)?|every|each|everything)\b",
    re.IGNORECASE,
)


_ASKING = """
    what where which who how many much there this that these those and the are show find between behind under above
    below inside next left right front with without except not near closest nearest farthest largest smallest thing
    things object objects everything anything something biggest tallest shortest leftmost rightmost middle second third
    bigger smaller larger taller shorter
"""
_FRAME = frozenset(_ASKING.split()) | COLORS
_NO_ERRORS = frozenset(re.findall(r"[a-z]+", " ".join(pattern for pattern, _ in _FRAMES)))


def with_asking_words(text: str) -> tuple[str, dict[str, str]]:
    """A question with the typing errors in its question words and colors corrected, and the corrections."""
    wrong = frame_errors(text, _FRAME, _vocabulary(), _NO_ERRORS)
    return re.sub(r"[^\W\d_]+", lambda word: wrong.get(word[0], word[0]), text), wrong


@lru_cache(1)
def _vocabulary() -> frozenset[str]:
    names = [*default_vocabulary(), *default_vocabulary("bundled"), *QUALITIES, *everyday_words()]
    return frozenset(word for name in names for word in name.lower().split())


def as_phrase(words: str) -> str:
    """A question or request without the words around the thing: "where can I find the mug" is "the mug".

    Args:
        words: One sentence `in_full` with single spaces, without the mark at its end.
    """
    whole, before = words, ""
    is_asked = False
    while words != before:
        before = words
        words = _without_tail(_TAG.sub("", _WHERE_IS_IT.sub("", words)))
        for pattern, instead in _COMPILED:
            found = pattern.match(words)
            if found is None:
                continue
            if instead == "something to @ in":
                instead = f"something to {' '.join(filter(None, found.groups()))} in"
            words = found.expand(instead) + words[found.end() :]
            if _is_count(found[0]):
                words = _COUNTED_TAIL.sub("", words)
            break
        else:
            if found := _IS.match(words):
                words, is_asked = words[found.end() :], True
    words = _PURPOSE.sub(r"something to \2", words)
    if is_asked:
        words = _with_quality_first(words) or f"is {words}"
    return words or whole


def not_understood(words: str) -> str:
    """Words of a question left over where a thing should be named; "" if none."""
    found = _LEFT_OVER.search(words)
    return found[0] if found else left_over(words)


def asks_yes_or_no(words: str) -> bool:
    """Whether a question asks for a yes or a no, such as "is there", "do you see"."""
    return _YES_OR_NO.match(words) is not None


def not_in_answer(words: str) -> str:
    """A note on what a question asks for in addition to a thing and its place; "" if nothing."""
    if _WHICH_COLOR.match(words):
        return 'the answer is the thing: "lexsplat list" tells colors'
    if re.match(r"what (?:is|are) .+ made (?:out )?(?:of|from)$", words, re.IGNORECASE):
        return 'the answer is the thing: a material is asked for by its name, as in "mug made of metal"'
    if _HOW_LARGE.search(words):
        return 'the answer is the thing: "lexsplat find" and "lexsplat list" tell its size'
    if _HOW_FAR.match(words):
        return 'the answer is the things: "lexsplat measure" tells how far apart two are'
    if _HOW_TO_GRASP.match(words):
        return 'the answer is the thing: a part is asked for by its name, as in "mug handle"'
    return ""


def command_note(words: str) -> str:
    """A note on a command to move, which a search does not do; "" if there is none."""
    found = _COMMAND.match(words)
    return f'"{found[1]}" is not done, only looked for' if found else ""


def at_one_moment(words: str) -> tuple[str, str]:
    """A question without "still", "already" and the like, and a note on it: a scene is one moment."""
    found = _MOMENT.search(words) if asks_yes_or_no(words) else None
    if found is None:
        return words, ""
    return _MOMENT.sub("", words), f'"{found[1]}" is left out: a scene is one moment'


def without_state(words: str) -> tuple[str, str]:
    """The thing whose state is asked for, and a note on that; any other question as it is, and ""."""
    found = _STATE.match(words)
    if found is None:
        return words, ""
    note = f'the answer is the thing: "{found["state"]}" is a state, which photos may not tell'
    return found["thing"], note


def says_more(statement: str) -> str:
    """The word of a statement that the grammar cannot check; "" if there is none.

    "Is only the duck on the table?"; "are all things on the table red?" and "is the largest toy on the table red?".
    """
    if found := _ONLY.search(statement):
        return found[1]
    last = _LAST_QUALITIES.match(statement)
    if last and _PLACED.search(last[1]) and (asks_for_all(statement) or _PICKED.search(last[1])):
        return last[2]
    return ""


def states(words: str) -> bool:
    """Whether a question asks if a statement is so: "is the mug on the table?", but not "is there a mug?"."""
    return _STATED.match(words) is not None


def asks_for_all(words: str) -> bool:
    """Whether a question asks for a yes about all of some things, such as "are all toys red?"."""
    return _ALL_OF.match(words) is not None


def _is_count(frame: str) -> bool:
    return bool(re.match(r"how (?:many|much)|count|.*\b(?:number|amount|quantity) of", frame, re.IGNORECASE))


def _without_tail(words: str) -> str:
    shorter = _TAIL.sub("", words)
    # "what is in the room" without its end is "what is"; a single preposition is no phrase.
    return shorter if len(shorter.split()) > 1 or shorter.lower() not in ("is", "are", "there") else words


def _with_quality_first(words: str) -> str:
    """The statement "the mug red" as a phrase: "red mug"; a statement with a place stays as it is.

    One about several things is none: "the apple red and the banana yellow".
    """
    found = _LAST_QUALITIES.match(words)
    if found and (noun := re.sub(r" not$", "", found[1], flags=re.IGNORECASE)) != found[1]:
        return f"{_ARTICLES.sub('', noun)} that is not {found[2]}"
    if found and re.search(r"\b(?:and|or)\b", found[1]):
        return ""
    return f"{found[2]} {_ARTICLES.sub('', found[1])}" if found else words


FOR_PAGES = {
    "tail": _TAIL, "tag": _TAG, "where_is_it": _WHERE_IS_IT, "is": _IS, "counted_tail": _COUNTED_TAIL,
    "purpose": _PURPOSE, "last_qualities": _LAST_QUALITIES, "articles": _ARTICLES, "left_over": _LEFT_OVER,
    "yes_or_no": _YES_OR_NO, "stated": _STATED, "only": _ONLY, "all_of": _ALL_OF, "state": _STATE, "moment": _MOMENT,
}  # fmt: skip
"""Patterns by which published pages read questions (`lexsplat.scenes.publishing.grammar`)."""
REPLACED = {
    "contractions": list(CONTRACTIONS),
    "reworded": list(REWORDED),
    "frames": list(_COMPILED),
}
"""Patterns and what pages put in their place, in this order."""
