import pytest

from controlmm import ops


@pytest.fixture(params=ops.available_isas() or ["no extension"])
def isa(request):
    """Runs the test once for each instruction set of this machine."""
    if not ops.available_isas():
        pytest.skip("the C++ extension is not built")
    with ops.use_isa(request.param):
        yield request.param
