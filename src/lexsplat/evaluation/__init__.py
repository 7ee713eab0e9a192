"""Evaluation of a scene on held-out views: image quality, language, speed and size, as in the paper's Table 1."""

from lexsplat.evaluation.ground_truth import GroundTruthSource
from lexsplat.evaluation.measuring import EvaluationConfig, evaluate
from lexsplat.evaluation.memory import forget_peak_memory, peak_gpu_memory, peak_memory
from lexsplat.evaluation.methods import Method, MethodScene
from lexsplat.evaluation.protocols import PROTOCOLS
from lexsplat.evaluation.results import THRESHOLD_KINDS, Metrics, PairResult, ViewImages
from lexsplat.evaluation.summary import precision_curves, summarize_kinds, summarize_language

__all__ = [
    "PROTOCOLS",
    "THRESHOLD_KINDS",
    "EvaluationConfig",
    "GroundTruthSource",
    "Method",
    "MethodScene",
    "Metrics",
    "PairResult",
    "ViewImages",
    "evaluate",
    "forget_peak_memory",
    "peak_gpu_memory",
    "peak_memory",
    "precision_curves",
    "summarize_kinds",
    "summarize_language",
]
