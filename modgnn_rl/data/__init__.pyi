from .collect import rollout_expert as rollout_expert
from .dataset import EpisodeDataset as EpisodeDataset
from .dataset import EpisodeWindows as EpisodeWindows
from .manifest import Manifest as Manifest
