from .html import write_replay as write_replay
from .image import write_image as write_image
from .recording import Frame as Frame
from .recording import Recording as Recording
from .video import write_video as write_video
from .viewer import Viewer as Viewer
