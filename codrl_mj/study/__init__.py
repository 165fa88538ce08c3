"""Studies: arms trained with many seeds, trials of their policies, and judged questions."""

from codrl_mj.study.inference import (
    Stratum,
    benjamini_hochberg,
    detectable_difference,
    effect,
    equivalence_p,
    holm,
    permutation_p,
)
from codrl_mj.study.pages import markdown_table, read_conclusions, read_csv, write_csv, write_page
from codrl_mj.study.parallel import Workers
from codrl_mj.study.program import Program, main
from codrl_mj.study.questions import (
    ComparisonVerdict,
    Contrast,
    Question,
    Scores,
    TrialComparison,
    Verdict,
    comparison_table,
    judge,
    judge_comparisons,
)
from codrl_mj.study.trials import Arm, Grid, StudyResults, Trial, run_rows, trial_rows

__all__ = [
    "Arm",
    "Trial",
    "Grid",
    "Workers",
    "StudyResults",
    "Contrast",
    "TrialComparison",
    "Question",
    "Scores",
    "Verdict",
    "ComparisonVerdict",
    "judge",
    "judge_comparisons",
    "comparison_table",
    "Program",
    "main",
    "run_rows",
    "trial_rows",
    "read_csv",
    "write_csv",
    "write_page",
    "markdown_table",
    "read_conclusions",
    "Stratum",
    "effect",
    "permutation_p",
    "equivalence_p",
    "holm",
    "benjamini_hochberg",
    "detectable_difference",
]
