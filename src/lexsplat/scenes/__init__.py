"""A built scene: its folder, questions to it, edits and exports."""
