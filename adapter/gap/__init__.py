"""Where a model and recordings disagree, which effect is missing, and the model with it."""
