"""Recognition of the objects of recorded sessions, each of which is an episode.

    result = i2t.recognize({"mug": mug, "bowl": bowl}, i2t.load_dataset("DATA"), i2t.load_pad_model("runs/skin"))
    print(result)  # the most probable object of each session, with its probability

Samples of one contact count as one touch. `python -m experiments.recognize --dataset` scores the same beliefs. Units
are metres, newtons and microtesla.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.dataset import Dataset, source_phrase
from i2t.errors import DataError
from i2t.intervals import rate_interval
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


class SessionTouches(NamedTuple):
    """The touches of recorded sessions that are used, in the order of time."""

    dataset: Dataset  # touches of the chosen sessions, with the samples of one contact merged
    sessions: Sessions
    pads: tuple[str, ...]  # names of the skins that made them
    samples: int  # number of recorded touches that were merged into others
    notes: tuple[str, ...]  # sentences about corrections
    warning: str | None  # sentence if the pad model is of another skin


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
    corrected, notes = corrected_dataset(dataset)
    merged = merge_samples(corrected)
    sessions = choose_sessions(merged, enough, touches)
    used = merged.select(np.isin(merged.touches.session, [merged.sessions.index(name) for name in sessions.names]))
    pads = tuple(used.pads[i] for i in np.unique(used.touches.pad))
    warning = require_skin(pad_model, pads, used.board, whose, other_skin=other_skin)
    return SessionTouches(used, sessions, pads, len(corrected) - len(merged), notes, warning)


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
            Lines of text: the number of sessions, notes, the table, and the rate of recognition.
        """
        count, touches = self.probability.shape[:2]
        is_candidate = np.isin(self.touched, self.names)
        rows = [("session", "object", "most probable", "probability")]
        rows += [
            (session, touched if among else f"{touched} (no candidate)", name, f"{probability:.2f}")
            for session, touched, among, name, probability in zip(
                self.sessions, self.touched, is_candidate, self.recognized, self.probability[:, -1].max(-1), strict=True
            )
        ]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        table = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        if max_sessions is not None and count > max_sessions:
            table[1 + max_sessions :] = [f"... {count - max_sessions} more"]
        title = f"{count} sessions of {touches} touches, {len(self.names)} objects ({source_phrase(self.source)})"
        lines = [title, *(f"note: {note}" for note in self.notes), *table]
        if is_candidate.any():
            right = np.array(self.recognized)[is_candidate] == np.array(self.touched)[is_candidate]
            rate, low, high = rate_interval(right.astype(float))
            chance = f"chance {1 / len(self.names):.2f}"
            lines.append(f"recognised {right.sum()} of {len(right)}: {rate:.2f} [{low:.2f}, {high:.2f}], {chance}")
        return "\n".join(lines)


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
    return RecognizedSessions(names, used.sessions.names, touched, beliefs, episodes, notes, used.dataset.source)
