"""Counts what a recording has lost, by time and by key, and describes it in words."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

MAX_KEYS_SHOWN = 8
MAX_GAPS_SHOWN = 3
MAX_GAPS = 1000  # that are counted separately; later losses are counted with the last one
# Topics made from other messages; `foxglove/` is that of older recordings.
VIEWER_PREFIXES = "/", "foxglove/"
UNKNOWN_KEYS = "keys that are not known"  # of messages whose channel is lost too


@dataclass
class LossGap:
    """Messages that are lost in one interval of robot time."""

    begin_ns: int  # robot time of the newest message before the gap
    end_ns: int | None = None  # robot time of the next readable message; None: there is none
    lost: Counter[str] = field(default_factory=Counter[str])  # known number of messages, by key


@dataclass
class RecordingLosses:
    """Everything that one file has lost."""

    gaps: list[LossGap] = field(default_factory=list[LossGap])
    # Position and kind of the first damages.
    damage_descriptions: list[str] = field(default_factory=list[str])
    damage_count: int = 0  # number of all damages
    truncated_at_ns: int | None = None  # the file has no end; robot time of its newest message
    misplaced_count: int = 0  # messages behind later ones of their key
    # Losses of the file that this one was copied from.
    earlier_losses: list[str] = field(default_factory=list[str])
    # By key: the disk was too slow.
    dropped_count_by_key: dict[str, int] = field(default_factory=dict[str, int])

    @property
    def lost_by_key(self) -> Counter[str]:
        """Return the number of messages that are known to be lost, by key."""
        return sum((gap.lost for gap in self.gaps), Counter[str]())

    def add_damage(self, position: int, reason: str, newest_ns: int) -> None:
        """Count a part of the file that cannot be read, and start a gap there.

        Args:
            position: Position of the damage, in bytes from the beginning of the file.
            reason: Description of the damage.
            newest_ns: Robot time of the newest message before the damage, in ns.
        """
        self.damage_count += 1
        if len(self.damage_descriptions) < MAX_GAPS_SHOWN:
            self.damage_descriptions.append(f"{reason} at byte {position}")
        self.open_gap(newest_ns)

    def open_gap(self, start_ns: int, end_ns: int | None = None) -> None:
        """Start a gap; if there are MAX_GAPS already, extend the last one instead.

        Args:
            start_ns: Robot time at which the gap starts, in ns.
            end_ns: Robot time at which it ends, in ns. None if that is not known yet.
        """
        if len(self.gaps) < MAX_GAPS:
            self.gaps.append(LossGap(start_ns, end_ns))
        else:
            self.gaps[-1].end_ns = end_ns

    def describe(self) -> list[str]:
        """Describe what is lost in a recording, for people.

        Returns:
            A text for each kind of loss: damaged parts, gaps, a cut end, messages that are out of order, messages that
            the recorder dropped, and what an earlier copy had lost. Empty if nothing is lost.
        """
        texts: list[str] = []
        if self.damage_count:
            texts.append(self._describe_damages())
        texts += self._describe_gaps()
        if self.truncated_at_ns is not None:
            texts.append(
                f"its end: it breaks off at {self.truncated_at_ns * 1e-9:.2f} s of robot time, because "
                "the recorder was killed, the disk was full, or the file was cut"
            )
        if self.misplaced_count:
            misplaced = _format_count(self.misplaced_count, "message")
            texts.append(f"its order: {misplaced} behind later ones of the same key")
        dropped_count = sum(self.dropped_count_by_key.values())
        if dropped_count:
            dropped = _format_count(dropped_count, "message")
            texts.append(
                f"{dropped}, dropped because the disk was too slow: {_list_keys(self.dropped_count_by_key)}"
            )
        earlier_texts = [
            f"before it was copied: {text}" for text in self.earlier_losses if text not in texts
        ]
        return texts + earlier_texts

    def _describe_damages(self) -> str:
        text = f"damaged in {_format_count(self.damage_count, 'place')}: {'; '.join(self.damage_descriptions)}"
        if self.damage_count > len(self.damage_descriptions):
            text += f" and {self.damage_count - len(self.damage_descriptions)} more"
        return text

    def _describe_gaps(self) -> list[str]:
        """Return one text for each of the first gaps in which messages are known to be lost, and one for the rest."""
        gaps = [gap for gap in self.gaps if gap.lost]
        texts = [_describe_gap(gap) for gap in gaps[:MAX_GAPS_SHOWN]]
        further_gaps = gaps[MAX_GAPS_SHOWN:]
        if further_gaps:
            messages = sum(gap.lost.total() for gap in further_gaps)
            gap_count = _format_count(len(further_gaps), "further gap")
            texts.append(f"{_format_count(messages, 'message')} in {gap_count}")
        return texts


def _describe_gap(gap: LossGap) -> str:
    start_s = gap.begin_ns * 1e-9
    if gap.end_ns is None:
        interval = f"after {start_s:.2f} s"
    else:
        interval = f"between {start_s:.2f} s and {gap.end_ns * 1e-9:.2f} s"
    count = _format_count(gap.lost.total(), "message")
    return f"{count} {interval} of robot time: {_list_keys(gap.lost)}"


def _list_keys(counts: Mapping[str, int]) -> str:
    """Return a text with keys and their message counts: the robot's own keys first, then topics made for viewers.

    Within each of these groups, the largest counts come first. Only MAX_KEYS_SHOWN keys are listed.
    """

    def rank(entry: tuple[str, int]) -> tuple[bool, int, str]:
        key, count = entry
        return key.startswith(VIEWER_PREFIXES), -count, key

    ranked = sorted(counts.items(), key=rank)
    texts = [f"{key} {count}" for key, count in ranked[:MAX_KEYS_SHOWN]]
    if len(ranked) > MAX_KEYS_SHOWN:
        texts.append(_format_count(len(ranked) - MAX_KEYS_SHOWN, "more key"))
    return ", ".join(texts)


def _format_count(number: int, noun: str) -> str:
    if number == 1:
        return f"{number} {noun}"
    return f"{number} {noun}s"
