import pytest

from btfpipe.errors import InputError, NumericalError, naming


@pytest.mark.parametrize("kind", [InputError, NumericalError])
def test_a_message_gets_its_file_once(kind):
    with pytest.raises(kind, match=r"^a\.npz: too dark$"), naming("a.npz"):
        raise kind("too dark")
    with pytest.raises(kind, match=r"^a\.npz: too dark$"), naming("a.npz"):
        raise kind("a.npz: too dark")
