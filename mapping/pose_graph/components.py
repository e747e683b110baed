"""Which poses of a graph hang together."""


class Sessions:
    """Sets of keys joined by edges, each named by its first key (union-find: Tarjan, JACM 1975)."""

    def __init__(self) -> None:
        self._parents: dict[int, int] = {}

    def add(self, key: int) -> None:
        """A key that nothing is joined to yet."""
        self._parents.setdefault(key, key)

    def join(self, first: int, second: int) -> None:
        """From now on the two are in one session."""
        low, high = sorted((self.first(first), self.first(second)))
        self._parents[high] = low

    def first(self, key: int) -> int:
        """The first key of the session that a key is in."""
        parents = self._parents
        while parents[key] != key:
            parents[key] = parents[parents[key]]
            key = parents[key]
        return key

    def all_first(self) -> set[int]:
        """The first key of every session."""
        return {key for key, parent in self._parents.items() if key == parent}
