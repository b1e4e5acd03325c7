"""Read and write pictures, maps, point clouds, text and JSON.

Readers accept any bytes and raise nothing but :class:`depthpose.core.errors.InputError`; writers
leave a whole file or none.
"""

from depthpose.core.files.cloud import CLOUD_READERS as CLOUD_READERS
from depthpose.core.files.cloud import PointCloud as PointCloud
from depthpose.core.files.cloud import read_cloud as read_cloud
from depthpose.core.files.cloud import read_points_bin as read_points_bin
from depthpose.core.files.cloud import write_cloud as write_cloud
from depthpose.core.files.disk import AnyPath as AnyPath
from depthpose.core.files.disk import atomic_write as atomic_write
from depthpose.core.files.disk import cache_folder as cache_folder
from depthpose.core.files.disk import read_bytes as read_bytes
from depthpose.core.files.disk import read_json as read_json
from depthpose.core.files.disk import read_key_values as read_key_values
from depthpose.core.files.disk import read_text as read_text
from depthpose.core.files.disk import refused_as as refused_as
from depthpose.core.files.disk import remove_parts as remove_parts
from depthpose.core.files.disk import write_json as write_json
from depthpose.core.files.images import DEPTH_SUFFIXES as DEPTH_SUFFIXES
from depthpose.core.files.images import MAP_SUFFIXES as MAP_SUFFIXES
from depthpose.core.files.images import encode_image as encode_image
from depthpose.core.files.images import image_size as image_size
from depthpose.core.files.images import list_images as list_images
from depthpose.core.files.images import read_depth_png as read_depth_png
from depthpose.core.files.images import read_exif_focal as read_exif_focal
from depthpose.core.files.images import read_image as read_image
from depthpose.core.files.images import read_map as read_map
from depthpose.core.files.images import read_stored_depth as read_stored_depth
from depthpose.core.files.images import rgb_from_pillow as rgb_from_pillow
from depthpose.core.files.images import write_depth_png as write_depth_png
from depthpose.core.files.images import write_image as write_image
from depthpose.core.files.images import write_map as write_map
from depthpose.core.files.pictures import AnyPicture as AnyPicture
from depthpose.core.files.pictures import rgb_from_picture as rgb_from_picture
from depthpose.core.files.video import VIDEO_SUFFIXES as VIDEO_SUFFIXES
from depthpose.core.files.video import Video as Video
from depthpose.core.files.video import read_video as read_video
from depthpose.core.files.video import write_video as write_video
