"""Evaluation on unseen tasks: success, SPL, return over optimum, first and contested choices."""

from __future__ import annotations

from hrlspec.evaluation.aggregate import Aggregate, aggregate
from hrlspec.evaluation.cases import BranchCases, Cases, make_branch_cases, make_cases
from hrlspec.evaluation.episodes import Episodes, run_episodes
from hrlspec.evaluation.first_choice import FirstChoiceEvaluation, FirstChoiceResult, first_choice_evaluation
from hrlspec.evaluation.ltl import FormulaScore, LtlResult, LtlSuite, evaluate_ltl, exact_suite, ltl_suite
from hrlspec.evaluation.protocol import (
    ChoiceEvaluation,
    ReturnEvaluation,
    SuiteEvaluation,
    choice_evaluation,
    evaluate_suite,
    final_evaluation,
    periodic_evaluation,
    return_evaluation,
)
from hrlspec.evaluation.recording import Record, record_episodes
from hrlspec.evaluation.results import ChoiceResult, ReturnResult, Score, SuiteResult, TaskScore
from hrlspec.evaluation.suite import Suite, suite_from_text, suite_from_trees

__all__ = [
    "Aggregate",
    "BranchCases",
    "Cases",
    "ChoiceEvaluation",
    "ChoiceResult",
    "Episodes",
    "FirstChoiceEvaluation",
    "FirstChoiceResult",
    "FormulaScore",
    "LtlResult",
    "LtlSuite",
    "Record",
    "ReturnEvaluation",
    "ReturnResult",
    "Score",
    "Suite",
    "SuiteEvaluation",
    "SuiteResult",
    "TaskScore",
    "aggregate",
    "choice_evaluation",
    "evaluate_ltl",
    "evaluate_suite",
    "exact_suite",
    "final_evaluation",
    "first_choice_evaluation",
    "ltl_suite",
    "make_branch_cases",
    "make_cases",
    "periodic_evaluation",
    "record_episodes",
    "return_evaluation",
    "run_episodes",
    "suite_from_text",
    "suite_from_trees",
]
