"""What a recording has lost, by time and by key, and the words for it. Pure."""

from collections import Counter
from dataclasses import dataclass, field

KEYS_SHOWN, GAPS_SHOWN = 8, 3
MOST_GAPS = 1000  # kept apart; what is lost behind them is counted with the last
SHOWN_ONLY = ("/", "foxglove/")  # made of the others; `foxglove/` in older recordings
ELSEWHERE = "keys that are not known"  # whose channel is lost too


@dataclass
class Gap:
    """Messages that are lost in one place."""

    begin_ns: int  # robot time of the newest message before it
    end_ns: int | None = None  # of the next one that can be read; None: there is none
    lost: Counter[str] = field(default_factory=Counter[str])  # by key; what nothing tells of is not in it


@dataclass
class Losses:
    """All of one file."""

    gaps: list[Gap] = field(default_factory=list[Gap])
    damaged: list[str] = field(default_factory=list[str])  # where the file is damaged, and how; the first ones
    places: int = 0  # so many in all
    cut_ns: int | None = None  # the file has no end; robot time of the newest message
    misplaced: int = 0  # messages behind later ones of their key
    earlier: list[str] = field(default_factory=list[str])  # what the file that this one was made of lacked
    dropped: dict[str, int] = field(default_factory=dict[str, int])  # by key: the disk was too slow

    @property
    def lost(self) -> Counter[str]:
        """Messages that are known to be lost, by key."""
        return sum((gap.lost for gap in self.gaps), Counter[str]())

    def damage(self, at: int, why: str, newest_ns: int) -> None:
        """A place that cannot be read."""
        self.places += 1
        if len(self.damaged) < GAPS_SHOWN:
            self.damaged.append(f"{why} at byte {at}")
        self.open_gap(newest_ns)

    def open_gap(self, begin_ns: int, end_ns: int | None = None) -> None:
        """Something is lost from there on."""
        if len(self.gaps) < MOST_GAPS:
            self.gaps.append(Gap(begin_ns, end_ns))
        else:
            self.gaps[-1].end_ns = end_ns

    def words(self) -> list[str]:
        """What is lost, for people; empty when nothing is."""
        said: list[str] = []
        if self.places:
            more = f" and {self.places - len(self.damaged)} more" if self.places > len(self.damaged) else ""
            said.append(f"damaged in {_count(self.places, 'place')}: {'; '.join(self.damaged)}{more}")
        known = [gap for gap in self.gaps if gap.lost]
        said += [_gap(gap) for gap in known[:GAPS_SHOWN]]
        if len(known) > GAPS_SHOWN:
            rest = sum(gap.lost.total() for gap in known[GAPS_SHOWN:])
            said.append(f"{_count(rest, 'message')} in {_count(len(known) - GAPS_SHOWN, 'further gap')}")
        if self.cut_ns is not None:
            said.append(
                f"its end: it breaks off at {self.cut_ns * 1e-9:.2f} s of robot time, because the recorder was killed, "
                "the disk was full, or the file was cut"
            )
        if self.misplaced:
            said.append(f"its order: {_count(self.misplaced, 'message')} behind later ones of the same key")
        if dropped := sum(self.dropped.values()):
            said.append(f"{_count(dropped, 'message')}, dropped because the disk was too slow: {_keys(self.dropped)}")
        return said + [f"before it was copied: {one}" for one in self.earlier if one not in said]


def _gap(gap: Gap) -> str:
    when = f"between {gap.begin_ns * 1e-9:.2f} s and {(gap.end_ns or 0) * 1e-9:.2f} s"
    if gap.end_ns is None:
        when = f"after {gap.begin_ns * 1e-9:.2f} s"
    return f"{_count(gap.lost.total(), 'message')} {when} of robot time: {_keys(gap.lost)}"


def _keys(counts: dict[str, int]) -> str:
    most = sorted(counts.items(), key=lambda one: (one[0].startswith(SHOWN_ONLY), -one[1], one[0]))
    shown = [f"{key} {count}" for key, count in most[:KEYS_SHOWN]]
    return ", ".join([*shown, *[f"{_count(len(most) - KEYS_SHOWN, 'more key')}"] * (len(most) > KEYS_SHOWN)])


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
