"""Captures, scenes, references and pretended devices that the tests share."""
