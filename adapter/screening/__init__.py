"""Whether a recording can be learned from: the same verdicts and sentences at every door."""
