"""What is asked of a predictor, and everything that decides what comes out: one tree of configurations."""

from __future__ import annotations

from dataclasses import dataclass, field

from dro_grasp.errors import OptionError
from dro_grasp.kinds import Checked, require_seed
from dro_grasp.predict.finish import FinishConfig, check_confidence
from dro_grasp.predict.sources.network import ProposalConfig, check_temperature
from dro_grasp.predict.sources.optimiser import OptimiserConfig
from dro_grasp.predict.sources.registry import source_or_name
from dro_grasp.predict.sources.source import AUTO, Source
from dro_grasp.predict.sources.variation import VariationConfig

LARGEST_CALL = 100_000  # Most candidates of one call; more do not fit memory


@dataclass(frozen=True)
class GraspRequest(Checked):
    """What is asked of a predictor."""

    num: int = 16
    """Grasps to return."""
    seed: int = 0
    """The same seed gives the same grasps."""
    candidates: int = 4
    """Most candidates proposed for each grasp returned, before rivals; the best by score are returned."""
    refine: bool = True
    """Refine and settle the candidates on the object's geometry before they are ranked."""
    temperature: float | None = None
    """Spread of z, from 0 to 2; None takes the predictor's."""
    source: str | Source = AUTO
    """What proposes: `auto`, `network`, `optimiser`, any other name that `make_source` knows, or a source."""
    least_confidence: float | None = None
    """Grasps that hold with less probability are not returned: 0 returns all. None takes the predictor's, and 0 without
    refinement."""

    def __post_init__(self) -> None:
        """Refuse what cannot be done, before any work.

        Raises:
            OptionError: `num` or `candidates` is not positive, another value is out of range, or there is no such source.
            GraspFileError: The source is a grasp file that cannot be read.
        """
        super().__post_init__()
        if self.num < 1:
            raise OptionError(f"num is {self.num}; ask for at least one grasp (num=16)")
        if self.candidates < 1:
            raise OptionError(f"candidates is {self.candidates}; propose at least one for each grasp")
        if self.num * self.candidates > LARGEST_CALL:
            raise OptionError(f"{self.num} grasps of {self.candidates} candidates each do not fit memory; predict at most "
                              f"{LARGEST_CALL} at once, with another seed for more (seed=1)")
        require_seed(self.seed)
        check_temperature(self.temperature)
        check_confidence(self.least_confidence or 0.0)
        if isinstance(self.source, str):
            object.__setattr__(self, "source", source_or_name(self.source))


@dataclass(frozen=True)
class RetryConfig(Checked):
    """How often a source is asked again when constraints reject its candidates, or too few are trusted (ours)."""

    first: int = 2
    """Candidates for each grasp that it is asked for at first, or half of those allowed if these are more, where candidates
    settle: some two thirds of the better ones are then trusted, and without need of rivals nothing more is made."""
    fewest: int = 8
    """Fewest candidates that it is then asked for, where so many are allowed: fewer take nearly as long."""
    rounds: int = 4
    """Largest number of times that it is asked."""
    least_yield: float = 0.2
    """It is not asked again if no larger share of its candidates was admitted."""
    reserve: float = 1.5
    """Factor on the number of candidates that the admitted or trusted share suggests for the next call."""


@dataclass(frozen=True)
class RescueConfig(Checked):
    """What is asked again where the score does not trust what there is: whatever source proved better (ours).

    The best candidates so far, varied, are a source too where nothing else was asked for by name.
    """

    trusted_scores: tuple[float, ...] = (1.5, *[1.0] * 7)
    """Log-odds of holding from which on a grasp needs no rival, in each round."""
    per_grasp: int = 8
    """Candidates in a round for each grasp that needs rivals."""
    trusted_in_surroundings: tuple[float, ...] = (1.5, 0.5, 0.0, 0.0)
    """Trusted scores where there are surroundings, with which a descent takes longer."""
    per_grasp_in_surroundings: int = 4
    """Candidates in a round where there are surroundings."""
    blind: int = 64
    """Candidates in each round but the first as long as nothing is trusted, however many grasps are asked for."""
    untried: int = 32
    """A source that was not asked yet counts like one of whose first candidates, as many, one is trusted."""
    patience: int = 200
    """Candidates that are made before a request may be given up."""
    hopeless: float = -7.0
    """It is given up if none of them scores better [log-odds]."""

    def rounds(self, surrounded: bool) -> tuple[tuple[float, ...], int]:
        """Trusted score of each round, and candidates for each grasp that needs rivals."""
        if surrounded:
            return self.trusted_in_surroundings, self.per_grasp_in_surroundings
        return self.trusted_scores, self.per_grasp


@dataclass(frozen=True)
class PredictorConfig(Checked):
    """Everything that decides which grasps are returned."""

    network: ProposalConfig = field(default_factory=ProposalConfig)
    """How the network proposes."""
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    """How the optimiser proposes."""
    variation: VariationConfig = field(default_factory=VariationConfig)
    """How the best candidates are varied."""
    retry: RetryConfig = field(default_factory=RetryConfig)
    """When a source is asked again."""
    finish: FinishConfig = field(default_factory=FinishConfig)
    """What becomes of candidates."""
    rescue: RescueConfig = field(default_factory=RescueConfig)
    """When rivals are made."""
    together: bool = False
    """Compute the objects of one call together on a CPU too, as on other devices: a check, which gains nothing."""
