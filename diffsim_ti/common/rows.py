"""Who owns which rows of an array: the one place where such a layout is worked out."""

from types import SimpleNamespace


class Rows:
    """Ranges of rows, one after the other, so that no two overlap; sizes: {owner: number of rows}."""

    def __init__(self, sizes: dict):
        self._of, self.total = {}, 0
        for owner, size in sizes.items():
            self._of[owner] = slice(self.total, self.total + int(size))
            self.total += int(size)

    def of(self, owner) -> slice:
        """The rows of an owner."""
        return self._of[owner]

    def first(self, owner) -> int:
        """The first row of an owner, -1 of what owns none."""
        return self._of[owner].start if owner in self._of else -1


def indices(**sizes: int) -> SimpleNamespace:
    """The first row of each owner, and `end`, the number of all, as attributes, which kernels read while they compile."""
    rows = Rows(sizes)
    return SimpleNamespace(**{owner: rows.first(owner) for owner in sizes}, end=rows.total)
