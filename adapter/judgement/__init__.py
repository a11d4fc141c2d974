"""What rows of recordings say of an arm: one noise, one table of priors, one posterior."""
