"""`python -m sim.fci`: the simulated robot without the rest of the project."""

import argparse
import sys

from sim.fci.command import run
from sim.fci.options import add_arguments

parser = argparse.ArgumentParser("python -m sim.fci", description=__doc__)
add_arguments(parser)
sys.exit(run(parser.parse_args()))
