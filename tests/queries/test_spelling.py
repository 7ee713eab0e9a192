"""Words of the dictionary: as simplemma has them, kept sorted, not read where everybody knows them; and singulars."""

import random

import pytest
import simplemma
from simplemma.strategies.dictionaries.dictionary_factory import DefaultDictionaryFactory

from lexsplat.queries import dictionary, spelling
from lexsplat.queries.everyday import everyday_words


@pytest.fixture
def no_words_yet(tmp_path, monkeypatch):
    """An empty cache of the user, and nothing kept by this process."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for kept in (dictionary._lines, dictionary._lemma_of):
        kept.cache_clear()
    yield tmp_path / "lexsplat"
    for kept in (dictionary._lines, dictionary._lemma_of):
        kept.cache_clear()


def test_everyday_words_are_in_the_dictionary_that_they_spare():
    assert len(spelling._everyday()) > 1_000
    assert [word for word in spelling._everyday() if not simplemma.is_known(word, lang="en")] == []


def test_an_everyday_word_is_known_without_the_dictionary_and_others_are_looked_up(monkeypatch):
    asked = []
    monkeypatch.setattr(dictionary, "is_english", lambda word: asked.append(word) or word == "ibex")
    assert [spelling.is_word(word) for word in ("Shoe", "blue", "ibex", "shoo")] == [True, True, True, False]
    assert asked == ["ibex", "shoo"]
    assert "shoe" in everyday_words()


@pytest.mark.slow
def test_the_kept_dictionary_answers_as_simplemma_does():
    entries = [word.lower() for word in DefaultDictionaryFactory().get_dictionary("en") if word.isalpha()]
    some = [entries[0], entries[-1], *random.Random(0).sample(entries, 2_000)]
    words = {form for word in some for form in (word, word + "s", word[:-1], "q" + word) if form}
    assert [w for w in words if dictionary.is_english(w) != simplemma.is_known(w, lang="en")] == []
    plurals = {word for word in words if word.endswith("s")}
    assert [w for w in plurals if dictionary.lemma(w) != simplemma.lemmatize(w, lang="en")] == []


@pytest.mark.slow
def test_the_dictionary_is_read_once_and_then_found_in_the_cache(no_words_yet, monkeypatch):
    assert dictionary.is_english("ibex")
    assert [file.name for file in no_words_yet.iterdir()] == [f"english-{simplemma.__version__}.tsv"]
    monkeypatch.setattr(dictionary, "_made", lambda: pytest.fail("read again"))
    dictionary._lines.cache_clear()
    dictionary._lemma_of.cache_clear()
    assert (dictionary.lemma("apples"), dictionary.is_english("applle")) == ("apple", False)


@pytest.mark.slow
def test_a_kept_dictionary_that_was_cut_off_is_made_again(no_words_yet):
    assert dictionary.is_english("ibex")
    (kept,) = no_words_yet.iterdir()
    whole = kept.read_bytes()
    kept.write_bytes(whole[: len(whole) // 2])
    dictionary._lines.cache_clear()
    dictionary._lemma_of.cache_clear()
    assert dictionary.is_english("zebra")
    assert kept.read_bytes() == whole


@pytest.mark.slow
def test_words_are_known_where_nothing_can_be_written(no_words_yet, monkeypatch):
    def refused(path, content):
        raise PermissionError(path)

    monkeypatch.setattr(dictionary, "write_file", refused)
    assert dictionary.is_english("ibex")
    assert not no_words_yet.exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plural", "one"),
    [("loaves", "loaf"), ("loaves of bread", "loaf of bread"), ("calves", "calf"), ("thieves", "thief"),
     ("knives", "knife"), ("gloves", "glove"), ("olives", "olive"), ("stoves", "stove")],
)  # fmt: skip
def test_plurals_of_f_have_their_singular(plural, one):
    assert spelling.singular(plural) == one
