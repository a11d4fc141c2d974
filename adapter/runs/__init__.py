"""Of one run: settings, the pipeline, replay, outcome, scores, the folder it leaves."""
