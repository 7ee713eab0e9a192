"""Text in, relevancy, thresholds, presence and selections out (supplement B)."""
