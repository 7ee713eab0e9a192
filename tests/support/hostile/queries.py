"""Reader of phrases."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from support.hostile import mutations as mutate
from support.hostile.registry import Reader, reader


@reader
def phrases() -> Reader:
    """Phrases as typed by people and programs: the bytes of the file are the phrase."""
    from lexsplat.queries.relevancy import check_prompts
    from lexsplat.scenes.answers import file_name
    from support.phrases import parse

    def read(folder: Path) -> Any:
        raw = (folder / "phrase.txt").read_bytes().decode("utf-8", "surrogateescape")
        (phrase,) = check_prompts([raw])
        return phrase, str(parse(phrase)), file_name(phrase)

    def check(result: tuple[str, str, str]) -> None:
        assert result[0].strip()
        assert "/" not in result[2]
        assert result[2] not in ("", ".", "..")

    good = 'how many "salt and pepper" mugs on the largest book but not the red cup nearest to 床'
    return Reader(lambda folder: (folder / "phrase.txt").write_text(good) and None, read, check,
                  {"phrase.txt": lambda c, r: mutate.text(c, r, 150, 90)})  # fmt: skip
