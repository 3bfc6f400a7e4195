"""The list of changes can be applied to the code as it is; `make mutants` applies them."""

import pytest
from mutants import problems, read_mutants

MUTANTS = read_mutants()


@pytest.mark.parametrize("mutant", MUTANTS, ids=[mutant["name"] for mutant in MUTANTS])
def test_every_change_can_be_applied_and_names_its_tests(mutant):
    assert problems(mutant) == []
