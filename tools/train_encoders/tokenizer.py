"""A byte-pair tokenizer of CLIP's form, learned from the phrases of `words.py`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, trainers
from transformers import CLIPTokenizer
from vocabulary import CANONICAL, COLORS, NAMES, PARTS, SYNONYMS, UNKNOWN_TRAINED
from words import any_phrase, in_sentence

VOCABULARY = 1400
LENGTH = 24
"""Most tokens of a text."""
_SPLIT = r"'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"


def learn_tokenizer(folder: Path, *, phrases: int = 60_000, seed: int = 0) -> CLIPTokenizer:
    """Learn the tokens of a sample of phrases and save the tokenizer."""
    rng = np.random.default_rng(seed)
    sample = [in_sentence(any_phrase(rng), rng) for _ in range(phrases)]
    sample += [*CANONICAL, *UNKNOWN_TRAINED] * 50
    for words in (NAMES, PARTS, COLORS, SYNONYMS):
        sample += [word for group in words.values() for word in group] * 50
    model = Tokenizer(
        models.BPE(unk_token="<|endoftext|>", end_of_word_suffix="</w>", continuing_subword_prefix="")
    )
    model.normalizer = normalizers.Sequence([normalizers.NFC(), normalizers.Lowercase()])
    model.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(_SPLIT), "removed", True),
            pre_tokenizers.ByteLevel(add_prefix_space=False),
        ]
    )
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    trainer = trainers.BpeTrainer(
        vocab_size=VOCABULARY, initial_alphabet=alphabet, end_of_word_suffix="</w>", show_progress=False
    )
    model.train_from_iterator(sample, trainer)
    learnt = json.loads(model.to_str())["model"]
    vocabulary = learnt["vocab"]
    merges = [tuple(m) if isinstance(m, list) else tuple(m.split(" ")) for m in learnt["merges"]]
    for byte in alphabet:  # any text can be written, whatever the sample held
        vocabulary.setdefault(byte + "</w>", len(vocabulary))
    for mark in ("<|startoftext|>", "<|endoftext|>"):
        vocabulary[mark] = len(vocabulary)
    tokenizer = CLIPTokenizer(vocab=vocabulary, merges=merges, model_max_length=LENGTH)
    tokenizer.save_pretrained(folder)
    return tokenizer
