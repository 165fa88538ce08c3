"""The paper's experiments done again: every arm over seeds, every reported number judged, every figure redrawn."""
