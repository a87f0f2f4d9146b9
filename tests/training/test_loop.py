"""Training and pretraining on a tiny bundle: progress, frozen parts, fine-tuning, BatchNorm, losses, priors."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from dro_grasp import distance_matrix
from dro_grasp.errors import TrainingError
from dro_grasp.network.encoder import StaticGraphEncoder
from dro_grasp.network.network import DistanceNetwork, NetworkOutput
from dro_grasp.training import loop
from dro_grasp.training.config import AugmentationConfig, LossConfig, MotionConfig, PretrainConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import Bundle, write_bundle
from dro_grasp.training.loop import measure_hands, train
from dro_grasp.training.measures import matching_rank
from dro_grasp.training.pretraining import contrastive_step, posture_clouds, pretrain_motion
from dro_grasp.training.runs import recalibrate
from dro_grasp.training.samples import Batch, SampleSource
from tests.helpers.loaded_hands import loaded_hand
from tests.helpers.tiny_bundle import TINY, ellipsoid, made_up_grasps
from tests.helpers.toy_hand import toy_hand
from tests.helpers.training_stages import SCHEDULE, STAGES, curve, quiet, run_stage


def test_losses_go_down_and_the_encoder_learns_to_match(bundle: Bundle, tmp_path: Path) -> None:
    schedule = dataclasses.replace(SCHEDULE, steps=50, log_every=10)
    learnt = run_stage("pretrain", bundle, tmp_path / "pre", schedule)
    assert curve(tmp_path / "pre")[-1]["total"] < 0.6 * curve(tmp_path / "pre")[0]["total"]
    source = SampleSource(bundle, TINY, AugmentationConfig())
    rank = matching_rank(learnt.hand_encoder, source, torch.Generator().manual_seed(0), 16)["toy"]
    assert rank < 0.3 * TINY.n_hand / 2, "chance is half the number of points"
    run_stage("train", bundle, tmp_path / "main", schedule)
    first, last = curve(tmp_path / "main")[0], curve(tmp_path / "main")[-1]
    assert last["total"] < first["total"]
    assert last["distance"] < 0.9 * first["distance"]


def test_a_frozen_encoder_stays_as_it_was(bundle: Bundle, tmp_path: Path) -> None:
    pretrained = run_stage("pretrain", bundle, tmp_path / "pre")
    before = copy.deepcopy(pretrained.hand_encoder.state_dict())
    config = TrainConfig(SCHEDULE, hands_per_step=1, columns=24)
    frozen = train(bundle, TINY, config, tmp_path / "frozen", pretrained, quiet).hand_encoder.state_dict()
    assert any("running_mean" in name for name in before)
    assert all(torch.equal(before[name], value) for name, value in frozen.items())
    free = train(
        bundle, TINY, dataclasses.replace(config, freeze_hand_encoder=False), tmp_path / "free", pretrained, quiet
    ).hand_encoder.state_dict()
    assert all("tracked" in name or not torch.equal(before[name], value) for name, value in free.items())


def test_fine_tuning_goes_on_from_given_weights(
    bundle: Bundle, results: dict[str, DistanceNetwork], finished: dict[str, Path], tmp_path: Path
) -> None:
    config = TrainConfig(SCHEDULE, hands_per_step=1, columns=24)
    tuned = train(bundle, TINY, config, tmp_path / "run", initial=results["train"], report=quiet)
    assert curve(tmp_path / "run")[0]["distance"] < curve(finished["train"])[0]["distance"]
    before, after = (m.hand_encoder.state_dict() for m in (results["train"], tuned))
    assert all(torch.equal(before[name], value) for name, value in after.items()), "the hand encoder is kept"


def contrast(encoder: StaticGraphEncoder, source: SampleSource, generator: torch.Generator) -> Tensor:
    config = PretrainConfig(hands_per_step=1)
    return contrastive_step(encoder, posture_clouds(source, config, generator), config)


def test_recalibration_measures_what_the_weights_make_of_the_data(bundle: Bundle) -> None:
    torch.manual_seed(0)
    encoder, source = DistanceNetwork(TINY).hand_encoder.train(), SampleSource(bundle, TINY, AugmentationConfig())
    frozen = nn.BatchNorm1d(3).eval()
    norm, momentum, inputs = encoder.final.norm, encoder.final.norm.momentum, []
    generator = torch.Generator().manual_seed(0)
    norm.register_forward_pre_hook(lambda _, given: inputs.append(given[0]))
    for parameter in encoder.parameters():
        nn.init.normal_(parameter)
    encoder.add_module("frozen", frozen)
    recalibrate(encoder, lambda: contrast(encoder, source, generator), batches=5)
    assert len(inputs) == 5
    torch.testing.assert_close(norm.running_mean, torch.stack([x.mean(0) for x in inputs]).mean(0))
    torch.testing.assert_close(norm.running_var, torch.stack([x.var(0) for x in inputs]).mean(0))
    assert norm.momentum == momentum
    assert frozen.num_batches_tracked == 0


@pytest.mark.parametrize("stage", STAGES)
def test_statistics_returned_belong_to_the_weights_returned(bundle: Bundle, tmp_path: Path, stage: str) -> None:
    model = run_stage(stage, bundle, tmp_path / "run", dataclasses.replace(SCHEDULE, recalibration=64))
    assert not any(m.training for m in model.modules())
    norm = model.hand_encoder.final.norm
    inputs: list[torch.Tensor] = []
    norm.register_forward_pre_hook(lambda _, given: inputs.append(given[0].detach()))
    source, generator = SampleSource(bundle, TINY, AugmentationConfig()), torch.Generator().manual_seed(5)
    for _ in range(20):
        if stage == "pretrain":
            contrast(model.hand_encoder, source, generator)
        else:
            hand = source.draw("toy", 4, generator).placed
            model.hand_encoder(hand - hand.mean(1, keepdim=True))
    x = torch.cat(inputs)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    assert float(((x.mean(0) - norm.running_mean) / x.std(0)).abs().max()) < 0.05
    assert float((x.var(0) / norm.running_var).log().abs().max()) < 0.1


@pytest.mark.parametrize("form", ["batch_mean", "official"])
def test_total_is_the_weighted_sum(bundle: Bundle, form: str) -> None:
    torch.manual_seed(0)
    source, generator = SampleSource(bundle, TINY, AugmentationConfig(partial=0.5)), torch.Generator().manual_seed(0)
    weights = LossConfig(2.0, 3.0, 5.0, 7.0, form, placement=11.0)
    model, batch = DistanceNetwork(TINY), Batch.of([source.draw("toy", 3, generator)])
    values = loop.step_losses(model, batch, TrainConfig(losses=weights, columns=24), generator)
    found = {name: float(value.detach()) for name, value in values.items()}
    assert found["total"] == pytest.approx(sum(getattr(weights, n) * v for n, v in found.items() if n not in {"total", "nats"}))
    assert found["nats"] > 0


class Noisy(DistanceNetwork):
    """Predicts true distances with noise."""

    def forward(self, hand: Tensor, obj: Tensor, grasp: Tensor, generator: torch.Generator, columns: int) -> NetworkOutput:
        distances = torch.cdist(grasp, obj[:, :columns])
        distances = distances + 0.003 * torch.randn(distances.shape, generator=generator)
        return NetworkOutput(distances, torch.zeros(len(hand), 1), torch.zeros(len(hand), 1), torch.zeros(len(hand)), hand)


@pytest.mark.parametrize(("points", "links"), [(48, [7, 1]), (96, [7, 21])], ids=["points that have no link", "padded links"])
def test_losses_of_several_hands_are_those_of_each_by_itself(points: int, links: list[int], tmp_path: Path) -> None:
    hands, clouds = [toy_hand(), loaded_hand("allegro")], {"egg": ellipsoid((0.12, 0.1, 0.11))}
    both = write_bundle(tmp_path / "b.safetensors", hands, clouds, [made_up_grasps(hand, "egg") for hand in hands])
    source = SampleSource(both, dataclasses.replace(TINY, n_hand=points), AugmentationConfig())
    assert source.segments.real.sum(1).tolist() == links
    assert bool(source.segments.kept.all()) == (points == 96)
    groups = [source.draw(hand.name, 3, torch.Generator().manual_seed(i)) for i, hand in enumerate(hands)]
    network = Noisy(dataclasses.replace(TINY, frame="object"))
    found = loop.step_losses(network, Batch.of(groups), TrainConfig(columns=24), torch.Generator().manual_seed(2))
    obj, grasp = (torch.cat([getattr(g, name) for g in groups]) for name in ("obj", "grasp"))
    output = network(grasp, obj, grasp, torch.Generator().manual_seed(2), 24)
    poses, depths = [], []
    for group, distances in zip(groups, output.distances.split(3), strict=True):
        links = distance_matrix.decode(group.hand, distances, group.obj[:, :24])
        turns, true = links.T_world_link[:, links.valid], group.T_frame_link[:, links.valid]
        trace = (turns[..., :3, :3] * true[..., :3, :3]).sum((-2, -1))
        poses.append((((trace - 1) / 2).clamp(-1, 1).acos() + (turns - true)[..., :3, 3].norm(dim=-1)).mean(1))
        kept = links.valid[group.hand.link_index]
        posed = group.hand.link_points[kept, None] @ links.T_world_link[:, group.hand.link_index[kept], :3, :3].mT
        posed = posed[:, :, 0] + links.T_world_link[:, group.hand.link_index[kept], :3, 3]
        nearest = torch.cdist(posed, group.obj).argmin(-1)
        rows = torch.arange(3)[:, None]
        depths.append((-((posed - group.obj[rows, nearest]) * group.normals[rows, nearest]).sum(-1)).clamp(min=0).mean(1))
    assert min(float(each.max()) for each in depths) > 0
    assert float(found["pose"]) == pytest.approx(float(torch.cat(poses).mean()), rel=1e-4)
    assert float(found["penetration"]) == pytest.approx(float(torch.cat(depths).mean()), rel=1e-4)


def test_prior_and_motion_learn(bundle: Bundle) -> None:
    torch.manual_seed(0)
    source, generator = SampleSource(bundle, TINY, AugmentationConfig()), torch.Generator().manual_seed(0)
    model = DistanceNetwork(TINY)
    batch = Batch.of([source.draw("toy", 3, generator)])
    loop.step_losses(model, batch, TrainConfig(columns=24), generator)["total"].backward()
    assert model.prior.leave.weight.grad.abs().max() > 0
    assert model.motion.last.weight.grad.abs().max() > 0


def test_a_placement_prior_learns_from_proportions(bundle: Bundle) -> None:
    torch.manual_seed(0)
    source, generator = SampleSource(bundle, TINY, AugmentationConfig()), torch.Generator().manual_seed(0)
    model = DistanceNetwork(TINY)
    measure_hands(model, source)
    state = torch.get_rng_state()
    batch = Batch.of([source.draw("toy", 3, generator)])
    loop.step_losses(model, batch, TrainConfig(columns=24), generator)["total"].backward()
    assert torch.equal(torch.get_rng_state(), state)
    assert model.placement.hand.weight.grad.abs().max() > 0, "noise tells a single hand's rows apart"
    assert all(p.grad is None or not p.grad.any() for name, p in model.hand_encoder.named_parameters() if "place" in name)
    turns = torch.linalg.qr(torch.randn(9, 3, 3, generator=generator))[0]
    placed = [model.sample_placements(source.points[0], turns, 9, torch.Generator().manual_seed(1), shape)[1]
              for shape in (source.proportions["toy"], source.proportions["toy"] + 0.1)]
    assert not torch.equal(*placed)


def test_a_motion_is_learned_before_objects_are_seen(bundle: Bundle, tmp_path: Path) -> None:
    network = dataclasses.replace(TINY, latent=8)
    fresh = DistanceNetwork(network)
    encoder = copy.deepcopy(fresh.hand_encoder.state_dict())
    schedule = dataclasses.replace(SCHEDULE, steps=200, log_every=10)
    learnt = pretrain_motion(fresh, bundle, MotionConfig(schedule, hands_per_step=1), tmp_path / "motion", quiet)
    lines = curve(tmp_path / "motion")
    assert lines[-1]["distance"] < 0.6 * lines[0]["distance"]
    assert all(torch.equal(encoder[k], v) for k, v in learnt.hand_encoder.state_dict().items())
    config = TrainConfig(SCHEDULE, hands_per_step=1, columns=24)
    train(bundle, network, config, tmp_path / "fresh", report=quiet)
    train(bundle, network, config, tmp_path / "taken", learnt, quiet)
    assert curve(tmp_path / "taken")[0]["motion"] < 0.7 * curve(tmp_path / "fresh")[0]["motion"]
    with pytest.raises(TrainingError, match="encoder"):  # what was learned of the features of one says nothing of another's
        pretrain_motion(
            DistanceNetwork(network), bundle, MotionConfig(schedule, hands_per_step=1), tmp_path / "motion", quiet)
    paper = DistanceNetwork(dataclasses.replace(TINY, frame="object"))
    with pytest.raises(TrainingError, match="frame 'object' has no motion"):
        pretrain_motion(paper, bundle, MotionConfig(schedule), tmp_path / "none", quiet)
