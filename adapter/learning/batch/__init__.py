"""λ and θ of any tree, learned in batch from recorded samples (paper, sections III and IV)."""
