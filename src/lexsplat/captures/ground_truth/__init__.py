"""Ground truth for evaluation: masks, boxes and lists of prompts."""
