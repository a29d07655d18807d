"""Which captions stay true when a motion is changed, and how two captions become one."""

from __future__ import annotations

import re

from controlmm.data.clip import Caption

JOINED_KIND = "joined"

# Words about what a change would make false. Rather leave a caption out than tell a lie.
_OF_SPEED = re.compile(
    r"\b(slow|quick|fast|speed|swift|rapid|brisk|hurr|rush|leisure|pace\b|paced|tempo|rhythm|second|meter|metre"
    r"|sprint|dash|trudg|shuffl|bolt|race|racing|flat out|urgen|sudden|gradual|moment|briefly|hertz)"
)
_OF_WAY = re.compile(
    r"\b(straight|direct|line\b|lines\b|turn|curv|circl|around|round\b|corner|left|right|veer|arc\b|bend|bent"
    r"|spin|rotat|pivot|degree|clockwise|counterclockwise|zigzag|loop|sideways|side to side|diagonal|backward"
    r"|back\b|return|end up|ends up|meter|metre)"
)
_OF_WHOLE = re.compile(
    r"\b(whole|entire|throughout|always|never|only|all the time|nothing|without|still\b|motionless"
    r"|keeps? \w+ing|continu|twice|once|times\b|second|meter|metre|degree|finally|in the end|starts?|begins?"
    r"|ends?\b|finish)"
)
_SUBJECT = re.compile(
    r"^(?:(?:a|an|the|this|some|one) )?(?:[a-z]+ )?"
    r"(?:person|man|woman|figure|human|character|individual|somebody|someone|guy|boy|girl|lady|dancer|subject"
    r"|he|she|actor|performer|child|adult) (?=(?:[a-z]+ly )?(?!as\b)[a-z]+s\b)"
)


def true_at_other_speed(captions: tuple[Caption, ...]) -> tuple[Caption, ...]:
    """The captions that name no speed, duration or distance in time."""
    return _without(captions, _OF_SPEED)


def true_on_bent_way(captions: tuple[Caption, ...]) -> tuple[Caption, ...]:
    """The captions that say nothing of a straight way, a turn, a side or a place reached."""
    return _without(captions, _OF_WAY)


def joined_captions(first: tuple[Caption, ...], second: tuple[Caption, ...]) -> tuple[Caption, ...]:
    """``FIRST, then SECOND`` for captions one by one; those that speak of a whole clip are left out.

    The second loses its subject ("a person walks", "the man waves" become "a person walks, then waves"), so
    that nobody reads of two people; captions without a plain subject are left out.
    """
    firsts = [text for text in map(_plain, _without(first, _OF_WHOLE)) if _SUBJECT.match(text)]
    seconds = [text for text in map(_plain, _without(second, _OF_WHOLE)) if _SUBJECT.match(text)]
    return tuple(
        Caption(f"{text}, then {_SUBJECT.sub('', other)}", JOINED_KIND)
        for text, other in zip(firsts, seconds, strict=False)
    )


def _without(captions: tuple[Caption, ...], lies: re.Pattern[str]) -> tuple[Caption, ...]:
    return tuple(c for c in captions if not c.is_partial and not lies.search(c.text.lower()))


def _plain(caption: Caption) -> str:
    return caption.text.strip().rstrip(".").lower()
