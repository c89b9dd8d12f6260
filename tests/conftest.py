import pytest
import torch as th


@pytest.fixture(autouse=True, scope="session")
def one_thread():
    """Networks this small are fastest on one core, and sums on one core have one order."""
    th.set_num_threads(1)
