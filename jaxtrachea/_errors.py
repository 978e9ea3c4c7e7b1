"""What is wrong with what came from outside, as fields: nobody has to take a sentence apart."""

import copyreg
from collections.abc import Mapping
from typing import Any, TypeVar

Own = TypeVar("Own", bound="InputError")


class InputError(ValueError):
    """Input that cannot be used; its text is `place: key: found; expected ...; cure`.

    Attributes:
        place: file, line or curve that the key stands in; may be empty, as all but `found`.
        key: argument or dotted key.
        found: what is wrong.
        expected: what would be right, where `found` does not say it.
        cure: what to do about it; `{}` stands for each of `arguments`.
        arguments: names that the cure holds, which whoever calls may know by others.
        joint: what stands between key and found.
    """

    def __init__(
        self,
        found: str,
        *,
        place: str = "",
        key: str = "",
        expected: str = "",
        cure: str = "",
        arguments: tuple[str, ...] = (),
        joint: str = ": ",
    ) -> None:
        """Say what is wrong; see the attributes."""
        super().__init__()
        self.place, self.key, self.found, self.expected = place, key, found, expected
        self.cure, self.arguments, self.joint = cure, arguments, joint
        self.args = (str(self),)  # what `repr` and loggers show

    def __str__(self) -> str:
        """All of it in a sentence."""
        head = f"{self.place}: {self.problem}" if self.place else self.problem
        cure = self.remedy
        if head.endswith("?"):
            return f"{head} {cure[:1].upper()}{cure[1:]}".rstrip()
        return f"{head}; {cure}" if cure else head

    def __reduce__(self) -> Any:
        """To other processes with all fields."""
        return copyreg.__newobj__, (type(self), str(self)), vars(self)  # pyright: ignore

    @property
    def problem(self) -> str:
        """What is wrong, without the place and the cure."""
        head = f"{self.key}{self.joint}{self.found}" if self.key else self.found
        return f"{head}; expected {self.expected}" if self.expected else head

    @property
    def remedy(self) -> str:
        """The cure with the names of its arguments."""
        return self.cure.format(*self.arguments) if self.arguments else self.cure

    @classmethod
    def like(cls: type[Own], error: "InputError", **fields: Any) -> Own:
        """The same as this kind of error."""
        made = cls.__new__(cls)
        made.__dict__.update(vars(error) | fields)
        made.args = (str(made),)
        return made

    def renamed(self: Own, names: Mapping[str, str]) -> Own:
        """The same for who knows the arguments by other names."""
        arguments = tuple(names.get(name, name) for name in self.arguments)
        return self.like(self, key=names.get(self.key, self.key), arguments=arguments)
