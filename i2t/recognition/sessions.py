"""Recognition of the objects of recorded sessions, each of which is an episode.

    result = i2t.recognize({"mug": mug, "bowl": bowl}, i2t.load_dataset("DATA"), i2t.load_pad_model("runs/skin"))
    print(result)  # the most probable object of each session, with its probability

Samples of one contact count as one touch. `python -m experiments.recognize --dataset` scores the same beliefs. Units
are metres, newtons and microtesla.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from i2t.dataset import Dataset, source_phrase
from i2t.dataset.digests import touch_digests
from i2t.errors import DataError
from i2t.intervals import MIN_CLUSTERS, rate_interval
from i2t.recognition import belief
from i2t.recognition.episodes import BeliefModel, Episodes, believe, episodes_from_dataset, usable_touches
from i2t.recognition.outcomes import placement_std
from i2t.recognition.recognizer import RecognizerConfig
from i2t.recognition.recorded import merge_samples
from i2t.recognition.site_pool import prepare_surfaces
from i2t.recordings.sets import corrected_dataset
from i2t.skin_models.pad_model import KnownPad, require_skin


class Sessions(NamedTuple):
    """The sessions that are used, and the numbers of their touches."""

    names: tuple[str, ...]  # in the order of the episodes
    touches: int  # number of touches that are used of each session, the first ones
    usable: tuple[int, ...]  # number of usable touches of each session
    left_out: tuple[str, ...]  # sessions with too few touches
    asked: int = 0  # touches of each session that the options or the preset ask for

    def describe(self) -> str:
        """Describe the sessions in one line."""
        fewest, most = min(self.usable), max(self.usable)
        sentence = f"{len(self.names)} sessions of {fewest if fewest == most else f'{fewest} to {most}'} usable touches"
        if most > self.touches:
            sentence += f", of which the first {self.touches} are used"
        if self.touches < self.asked:
            sentence += f"; no session has the {self.asked} that were asked for"
        if self.left_out:
            sentence += f"; left out, with too few: {', '.join(self.left_out)}"
        return sentence


def choose_sessions(recorded: Dataset, enough: int, max_touches: int | None) -> Sessions:
    """Choose the sessions that are long enough, and the number of touches to use of each.

    Args:
        recorded: The data set.
        enough: Minimum number of touches of a session, if `max_touches` is None.
        max_touches: Number of touches to use of each session; by default the number in the shortest chosen session.

    Returns:
        The sessions with the number of touches.

    Raises:
        DataError: No session has a usable touch, or `max_touches` of them.
    """
    counts = {recorded.sessions[i]: len(rows) for i, rows in usable_touches(recorded.touches).items()}
    longest = max(counts.values(), default=0)
    if not longest or (max_touches or 0) > longest:
        raise DataError(
            f"no session has {max_touches or 'any'} touches with a measured force; the longest has {longest}"
        )
    least = max_touches or min(enough, longest)
    kept = {name: count for name, count in counts.items() if count >= least}
    return Sessions(
        names=tuple(kept),
        touches=max_touches or min(kept.values()),
        usable=tuple(kept.values()),
        left_out=tuple(f"{name} ({count})" for name, count in counts.items() if name not in kept),
        asked=max_touches or enough,
    )


def require_objects_touched(dataset: Dataset, whose: str = "dataset") -> None:
    """Refuse presses of an indenter, whose data set has the skin's frame as that of the world.

    Args:
        dataset: Recorded touches.
        whose: Name of the data set in messages.

    Raises:
        DataError: The touches are presses of an indenter.
    """
    T_w_t = np.asarray(dataset.touches.T_w_t)
    if len(T_w_t) > 1 and (T_w_t == np.eye(4)).all():
        tips = ", ".join(dataset.objects)
        raise DataError(f"{whose}: holds presses of an indenter ({tips}), and thus no object to recognise")


class SessionTouches(NamedTuple):
    """The touches of recorded sessions that are used, in the order of time."""

    dataset: Dataset  # touches of the chosen sessions, with the samples of one contact merged
    sessions: Sessions
    pads: tuple[str, ...]  # names of the skins that made them
    samples: int  # number of recorded touches that were merged into others
    notes: tuple[str, ...]  # sentences about corrections
    warning: str | None  # sentence if the pad model is of another skin
    # whether the pad model was fitted to touches of each session; None if it does not hold a record of its touches
    in_fit: tuple[bool, ...] | None


def session_touches(
    dataset: Dataset,
    pad_model: KnownPad,
    *,
    enough: int,
    touches: int | None = None,
    other_skin: bool = False,
    whose: str = "dataset",
) -> SessionTouches:
    """Correct recorded touches, merge samples of one contact, and choose the sessions that are long enough.

    Args:
        dataset: Recorded touches.
        pad_model: Pad model of the skin that made them.
        enough: Minimum number of touches of a session, if `touches` is None.
        touches: Number of touches to use of each session; by default the number in the shortest chosen session.
        other_skin: Whether touches of another skin than the pad model's are allowed.
        whose: Name of the data set in messages.

    Returns:
        The touches of the chosen sessions.

    Raises:
        DataError: No session has enough touches, or the touches are of another skin.
    """
    require_objects_touched(dataset, whose)
    corrected, notes = corrected_dataset(dataset)
    merged = merge_samples(corrected)
    sessions = choose_sessions(merged, enough, touches)
    used = merged.select(np.isin(merged.touches.session, [merged.sessions.index(name) for name in sessions.names]))
    pads = tuple(used.pads[i] for i in np.unique(used.touches.pad))
    warning = require_skin(pad_model, pads, used.board, whose, other_skin=other_skin)
    in_fit = _sessions_in_fit(dataset, pad_model, sessions.names)
    return SessionTouches(used, sessions, pads, len(corrected) - len(merged), notes, warning, in_fit)


def _sessions_in_fit(dataset: Dataset, pad_model: KnownPad, names: Sequence[str]) -> tuple[bool, ...] | None:
    """Find the sessions with touches to which a pad model was fitted."""
    digests = pad_model.origin.used_touches
    if digests is None:
        return None
    rows = np.isin(touch_digests(dataset), digests)
    fitted = {dataset.sessions[i] for i in np.unique(dataset.touches.session[rows])}
    return tuple(name in fitted for name in names)


@dataclass(frozen=True, repr=False)
class RecognizedSessions:
    """Beliefs about the objects of e recorded sessions after each of t touches; it prints itself as a table.

    Attributes:
        names: Names of the o candidate objects.
        sessions: Names of the sessions.
        touched: Names of the objects that the data set states, which need not be among the candidates.
        beliefs: `(e, t, o)` probabilities by the kind of evidence (`i2t.recognition.episodes.EVIDENCE_WEIGHTS`).
        episodes: The touches.
        notes: Sentences about the touches.
        source: Source of the touches: "simulated", "real", "mixed" or "not stated".
        in_fit: Whether the pad model was fitted to touches of each session, which then does not count in the rate; None
            if the pad model does not hold a record of its touches.
        fitted_objects: Names of the objects to whose touches the pad model was fitted.

    Example:
        result = i2t.recognize(meshes, dataset, pad_model)
        print(result)
        result.recognized, result.probability[:, -1]  # names, and (e, o) probabilities after all touches
    """

    names: tuple[str, ...]
    sessions: tuple[str, ...]
    touched: tuple[str, ...]
    beliefs: Mapping[str, Float[np.ndarray, "e t o"]]
    episodes: Episodes
    notes: tuple[str, ...]
    source: str
    in_fit: tuple[bool, ...] | None = None
    fitted_objects: tuple[str, ...] = ()

    @property
    def probability(self) -> Float[np.ndarray, "e t o"]:
        """Probabilities of the objects after each touch, from readings, positions and presence."""
        return self.beliefs["fused"]

    @property
    def recognized(self) -> tuple[str, ...]:
        """Name of the most probable object of each session after all its touches."""
        return tuple(self.names[i] for i in self.probability[:, -1].argmax(-1))

    def __repr__(self) -> str:
        return f"RecognizedSessions({len(self.sessions)} sessions, {len(self.names)} objects, {self.source})"

    def __str__(self) -> str:
        return self.table(max_sessions=6)

    def table(self, max_sessions: int | None = None) -> str:
        """Write a line for each session, and the number that were recognised.

        Args:
            max_sessions: Maximum number of sessions to list; by default, all are listed.

        Returns:
            Lines of text: the number of sessions, notes, the table, and the rate of recognition of the sessions that
            were not used in the fit of the pad model, with a 95 % interval over their objects.
        """
        count, touches = self.probability.shape[:2]
        in_fit = np.array(self.in_fit or [False] * count)
        rows = [("session", "object", "most probable", "probability", "")]
        rows += [
            (
                session,
                touched if touched in self.names else f"{touched} (no candidate)",
                name,
                f"{probability:.2f}",
                "used in the fit" if fitted else "",
            )
            for session, touched, name, probability, fitted in zip(
                self.sessions, self.touched, self.recognized, self.probability[:, -1].max(-1), in_fit, strict=True
            )
        ]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        table = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        if max_sessions is not None and count > max_sessions:
            table[1 + max_sessions :] = [f"... {count - max_sessions} more"]
        title = f"{count} sessions of {touches} touches, {len(self.names)} objects ({source_phrase(self.source)})"
        return "\n".join([title, *(f"note: {note}" for note in self.notes), *table, *self._score_lines(in_fit)])

    def _score_lines(self, in_fit: Bool[np.ndarray, " e"]) -> list[str]:
        """Write the rates over the sessions of candidates that were not used in the fit, and what they depend on."""
        touched = np.array(self.touched)
        counts = np.isin(touched, self.names) & ~in_fit
        lines = []
        if counts.any():
            right = {
                kind: (np.array(self.names)[p[counts, -1].argmax(-1)] == touched[counts]).astype(float)
                for kind, p in self.beliefs.items()
            }
            fused, objects = right["fused"], len(np.unique(touched[counts]))
            rate, low, high = rate_interval(fused, [touched[counts]])
            interval = f"no interval: {objects} object{'s' * (objects > 1)}"
            if objects >= MIN_CLUSTERS:
                interval = f"95 % interval [{low:.2f}, {high:.2f}] over {objects} objects"
            sessions = f"{len(fused)} sessions{' that were not used in the fit' * bool(in_fit.any())}"
            chance = f"chance {1 / len(self.names):.2f}"
            lines.append(f"recognised {fused.sum():.0f} of {sessions}: {rate:.2f} ({interval}; {chance})")
            parts = [f"{kind} {right[kind].mean():.2f}" for kind in ("position and presence", "readings")]
            lines.append(f"by kind of evidence: all {rate:.2f}, {', '.join(parts)}")
        if in_fit.any():
            lines.append(f"{in_fit.sum()} of the {len(in_fit)} sessions were used in the fit of the pad model")
        elif self.in_fit is None:
            lines.append("whether these sessions were used in the fit of the pad model is not recorded")
        if also := sorted(set(touched[counts]) & set(self.fitted_objects)):
            lines.append(f"the pad model was also fitted to touches of {', '.join(also)}")
        return lines


def recognize(
    meshes: Mapping[str, Any],
    dataset: Dataset,
    pad_model: KnownPad,
    *,
    covariance: Float[np.ndarray, "6 6"] | None = None,
    config: RecognizerConfig | None = None,
    touches: int | None = None,
    other_skin: bool = False,
) -> RecognizedSessions:
    """Recognise the objects of recorded sessions, in each of which one object was touched at one place.

    Signs of forces and travels are corrected, and samples of one contact are merged.

    Args:
        meshes: Meshes of the candidate objects, by name.
        dataset: Recorded touches with tool poses, the believed pose of the object, and forces.
        pad_model: Pad model of the skin that made them.
        covariance: Covariance (m^2) of the object's pose, rotations in arc lengths; 1 mm and 1 degree along and about
            each axis by default.
        config: Number and seed of the poses, and the distance beyond a site after which a press without contact ended.
            Sessions with fewer than its `max_touches` touches are left out if longer ones exist.
        touches: Number of touches to use of each session; by default the number in the shortest chosen session.
        other_skin: Whether touches of another skin than the pad model's are allowed.

    Returns:
        Probabilities of the objects in each session after each touch.

    Raises:
        DataError: No session has enough touches, or the touches are of another skin.
        TypeError: `meshes` is no mapping, `dataset` no data set, or `pad_model` no pad model with its skin.
        ValueError: There are fewer than two objects.

    Example:
        meshes = {name: i2t.make_object(name).mesh for name in ("star", "hammer")}
        print(i2t.recognize(meshes, dataset, i2t.load_pad_model("nominal")))
    """
    if not isinstance(meshes, Mapping):
        raise TypeError(f"meshes: is a {type(meshes).__name__}; give a mapping of names to meshes")
    if not isinstance(dataset, Dataset):
        raise TypeError(f"dataset: is a {type(dataset).__name__}; give a data set, as i2t.load_dataset reads it")
    if not isinstance(pad_model, KnownPad):
        raise TypeError(f"pad_model: is a {type(pad_model).__name__}; give one, as i2t.load_pad_model reads it")
    if len(meshes) < 2:
        raise ValueError(f"meshes: holds {len(meshes)} objects; give at least two to distinguish")
    config = config or RecognizerConfig()
    used = session_touches(dataset, pad_model, enough=config.max_touches, touches=touches, other_skin=other_skin)
    return recognize_sessions(meshes, used, pad_model, covariance=covariance, config=config, require_known=False)


def recognize_sessions(
    meshes: Mapping[str, Any],
    used: SessionTouches,
    pad_model: KnownPad,
    *,
    covariance: Float[np.ndarray, "6 6"] | None = None,
    config: RecognizerConfig,
    require_known: bool = True,
) -> RecognizedSessions:
    """Compute the beliefs in recorded sessions, which are independent trials.

    Args:
        meshes: Meshes of the candidate objects, by name.
        used: The touches of the sessions.
        pad_model: Pad model of the skin that made them.
        covariance: Covariance (m^2) of the object's pose, as for `recognize`.
        config: Options, as for `recognize`.
        require_known: Whether the object of each session must be a candidate.

    Returns:
        Probabilities of the objects in each session after each touch.

    Raises:
        DataError: An object is not a candidate, and `require_known` is set.
    """
    covariance = np.diag(placement_std(1e-3, float(np.radians(1.0))) ** 2) if covariance is None else covariance
    particles = belief.sample_particles(covariance, config.num_particles, config.seed)
    names, model = tuple(meshes), pad_model.model
    sites, episodes = episodes_from_dataset(
        used.dataset, names, used.sessions.touches, overtravel=config.overtravel, require_known=require_known
    )
    beliefs = believe(
        prepare_surfaces(list(meshes.values())), sites, episodes, particles,
        {"": BeliefModel(model.reading_model, model.likelihood)}, overtravel=config.overtravel, label="recorded",
    )  # fmt: skip
    touches, numbers = used.dataset.touches, [used.dataset.sessions.index(name) for name in used.sessions.names]
    touched = tuple(used.dataset.objects[touches.object[touches.session == number][0]] for number in numbers)
    notes = (*used.notes, *([used.warning] if used.warning else []))
    return RecognizedSessions(
        names, used.sessions.names, touched, beliefs, episodes, notes, used.dataset.source, used.in_fit,
        pad_model.origin.objects,
    )  # fmt: skip
