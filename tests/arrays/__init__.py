"""Tests of the back ends for C and for arrays."""
