"""What follows from a model of a robot: the paper's formulas, each once in torch and once compiled.

`networks` (torch) defines them for any tree; `kernels` (numba) has the same for one sample and for
tables; `rigid_arm` puts a self model behind the kernels; `identifiability` counts what they can
show of λ and θ. Callers take the file they need: torch takes a second to load.
"""
