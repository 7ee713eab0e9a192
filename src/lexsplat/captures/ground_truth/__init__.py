"""Annotations to measure against: masks, boxes and lists of prompts."""
