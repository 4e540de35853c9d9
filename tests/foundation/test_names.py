"""Order and comparison of names."""

from foundation.names import natural_sort_key


def test_sorts_numbers_in_names_by_value() -> None:
    names = ["10.png", "9.png", "IMG_0010.png", "IMG_9.png", "a", "1a10", "1a9"]
    assert sorted(names, key=natural_sort_key) == ["1a9", "1a10", "9.png", "10.png", "IMG_9.png", "IMG_0010.png", "a"]
