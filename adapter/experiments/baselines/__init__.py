"""Learners that the paper, or a user today, would take for the inverse dynamics of one arm."""
