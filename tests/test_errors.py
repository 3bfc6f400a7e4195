import pytest

from btfpipe.errors import InputError, NumericalError, amount, naming, too_little


@pytest.mark.parametrize("kind", [InputError, NumericalError])
def test_a_message_gets_its_file_once(kind):
    with pytest.raises(kind, match=r"^a\.npz: too dark$"), naming("a.npz"):
        raise kind("too dark")
    with pytest.raises(kind, match=r"^a\.npz: too dark$"), naming("a.npz"):
        raise kind("a.npz: too dark")


@pytest.mark.parametrize(
    ("size", "up", "down"),
    [
        (0, "0 KB", "0 KB"),
        (1, "1 KB", "0 KB"),
        (100 << 10, "100 KB", "100 KB"),
        ((1 << 20) - 1, "1024 KB", "1023 KB"),
        (1 << 20, "1 MB", "1 MB"),
        ((2 << 30) + 1, "2049 MB", "2048 MB"),
    ],
)
def test_amounts_are_written_in_mb_or_kb(size, up, down):
    assert amount(size) == up
    assert too_little(size, size) == f"{up}; --memory allows {down}. Raise it"
