"""What benchmarks refuse before they measure."""

import pytest

from benchmarks.common import trainer_of
from hrlspec.run.errors import UserError


def test_environments_that_minibatches_do_not_share_evenly_are_refused() -> None:
    assert trainer_of("letter", "hrlspec", 1, 1024).agent.config.num_envs == 1024
    with pytest.raises(UserError, match=r"--devices 1, 101 environments: .*minibatches"):
        trainer_of("letter", "hrlspec", 1, 101)
