"""The observers of all struts of a model: each alone, or those of coupled struts in one filter."""

from collections.abc import Sequence

from msgspec import Struct

from rig.observers.error_model import ErrorModel
from rig.observers.joint_filter import JointFilter, JointState
from rig.observers.joint_model import FollowedStrut, JointModel
from rig.observers.protocol import AnyObserver, Innovation, ObserverState, Start


class ObserversState(Struct, frozen=True, gc=False):
    """State of all observers of a model.

    Attributes:
        struts: Of each strut.
        joint: State of the joint filter; None where every strut is observed alone.
    """

    struts: tuple[ObserverState, ...] = ()
    joint: JointState | None = None


class StrutObservers:
    """The observers of a model's struts, in their order.

    Where a strut with a noise-aware observer moves another one, or has several sensors, all of this
    kind are one filter, which knows the laws of the other struts. Otherwise, and of any other kind,
    each knows its own strut alone.
    """

    def __init__(self, observers: Sequence[AnyObserver]) -> None:
        self.each = tuple(observers)
        # A strut that has a known law has no limit of its own.
        largest_n = max((it.force_limit_n for it in self.each), default=0.0)
        self._limits_n = [it.force_limit_n or largest_n for it in self.each]

    def init(
        self, starts: Sequence[Start], model: ErrorModel, before: ObserversState
    ) -> ObserversState:
        """State at the model's start, without virtual forces.

        `before` is the state before a gap, of which is kept what the gap did not change; it is
        empty at the first start.
        """
        joint = self._make_joint(starts, model)
        t_ns = self._newest_ns(starts)
        joint_state = None
        if joint is not None:
            was = before.joint
            joint_state = joint.init(t_ns) if was is None else joint.restart(t_ns, was)
        struts = tuple(
            observer.restart(before.struts[strut], start)
            if before.struts and not _is_joint(observer, before.joint or joint_state)
            else observer.init(start)
            for strut, (observer, start) in enumerate(zip(self.each, starts, strict=True))
        )
        return self._join(struts, joint_state)

    def steady_state(self, starts: Sequence[Start], model: ErrorModel) -> ObserversState:
        """State after a long time without an error."""
        joint = self._make_joint(starts, model)
        t_ns = self._newest_ns(starts)
        struts = tuple(
            observer.steady_state(start) for observer, start in zip(self.each, starts, strict=True)
        )
        return self._join(struts, None if joint is None else joint.steady_state(t_ns))

    def step(
        self,
        state: ObserversState,
        t_ns: int,
        innovations: Sequence[Innovation | None],
        further: Sequence[Sequence[Innovation]] = (),
    ) -> ObserversState:
        """State after a tick, with the innovations of new heights and further sensors by strut."""
        if state.joint is None:
            return ObserversState(
                tuple(
                    [
                        observer.step(before, t_ns, innovation)
                        for observer, before, innovation in zip(
                            self.each, state.struts, innovations, strict=True
                        )
                    ]
                )
            )
        follower = state.joint.filter
        limits_n = [self._limits_n[strut] for strut in follower.followed]
        joint = follower.step(state.joint, t_ns, innovations, further, limits_n)
        struts = tuple(
            before if _is_joint(observer, joint) else observer.step(before, t_ns, innovation)
            for observer, before, innovation in zip(
                self.each, state.struts, innovations, strict=True
            )
        )
        return self._join(struts, joint)

    def with_slopes(
        self, state: ObserversState, slopes: Sequence[tuple[float, float]]
    ) -> ObserversState:
        """State of observers that know the slopes of the model's laws where it is now.

        They are stiffness (N/m) and damping (N·s/m) of each strut.
        """
        if state.joint is not None:
            joint = state.joint.filter.with_slopes(state.joint, slopes)
            return ObserversState(state.struts, joint)
        return ObserversState(
            tuple(
                [
                    observer.with_slopes(before, *of_strut)
                    for observer, before, of_strut in zip(
                        self.each, state.struts, slopes, strict=True
                    )
                ]
            )
        )

    def numbers(self, state: ObserversState) -> list[float]:
        """What of a state the next one depends on, but for times and variances."""
        joint = state.joint
        found = [] if joint is None else joint.filter.numbers(joint)
        for observer, strut in zip(self.each, state.struts, strict=True):
            if not _is_joint(observer, joint):
                found += observer.numbers(strut)
        return found

    def with_numbers(self, state: ObserversState, numbers: Sequence[float]) -> ObserversState:
        """A state with other numbers, as `numbers` returns them."""
        joint, first = state.joint, 0
        if joint is not None:
            first = len(joint.filter.numbers(joint))
            joint = joint.filter.with_numbers(joint, numbers[:first])
        struts: list[ObserverState] = []
        for observer, before in zip(self.each, state.struts, strict=True):
            if _is_joint(observer, joint):
                struts.append(before)
                continue
            end = first + len(observer.numbers(before))
            struts.append(observer.with_numbers(before, numbers[first:end]))
            first = end
        return self._join(struts, joint)

    def _newest_ns(self, starts: Sequence[Start]) -> int:
        """Time of the newest height that a joint filter begins with."""
        pairs = zip(self.each, starts, strict=True)
        return max((start.t_ns for it, start in pairs if it.height_std_m is not None), default=0)

    def _make_joint(self, starts: Sequence[Start], model: ErrorModel) -> JointFilter | None:
        own = [strut for strut, it in enumerate(self.each) if it.force_filter is not None]
        if not any(model.moves_another(strut) or starts[strut].sensors for strut in own):
            return None
        followed = [
            FollowedStrut(strut, observer.height_std_m, observer.force_filter)
            for strut, observer in enumerate(self.each)
            if observer.height_std_m is not None
        ]
        return JointFilter(JointModel(model, starts, followed))

    def _join(self, struts: Sequence[ObserverState], joint: JointState | None) -> ObserversState:
        """State with what the joint filter says of the struts that it knows."""
        if joint is None:
            return ObserversState(tuple(struts))
        every = zip(self.each, struts, joint.struts, strict=True)
        return ObserversState(
            tuple(
                of_filter if _is_joint(observer, joint) else own
                for observer, own, of_filter in every
            ),
            joint,
        )


def _is_joint(observer: AnyObserver, joint: JointState | None) -> bool:
    """Whether a joint filter says what is known of the observer's strut."""
    return joint is not None and observer.is_joinable
