"""Known objects: model files, diameter, keypoints, surface points, symmetries, units."""

from depthpose.pose.mesh.files import FIXED_UNITS as FIXED_UNITS
from depthpose.pose.mesh.files import MESH_READERS as MESH_READERS
from depthpose.pose.mesh.files import read_geometry as read_geometry
from depthpose.pose.mesh.files import unit_of as unit_of
from depthpose.pose.mesh.models import drawn_triangles as drawn_triangles
from depthpose.pose.mesh.models import exact_diameter as exact_diameter
from depthpose.pose.mesh.models import farthest_points as farthest_points
from depthpose.pose.mesh.models import gap_to_surface_m as gap_to_surface_m
from depthpose.pose.mesh.models import make_model as make_model
from depthpose.pose.mesh.models import read_model as read_model
from depthpose.pose.mesh.models import refuse_one_name as refuse_one_name
from depthpose.pose.mesh.models import sample_surface as sample_surface
from depthpose.pose.mesh.models import symmetries_from_bop as symmetries_from_bop
from depthpose.pose.mesh.models import symmetries_to_bop as symmetries_to_bop
from depthpose.pose.mesh.models import symmetry_transforms as symmetry_transforms
from depthpose.pose.mesh.models import turn_about as turn_about
from depthpose.pose.mesh.symmetry import MIRROR_ALIKE as MIRROR_ALIKE
from depthpose.pose.mesh.symmetry import NearSymmetry as NearSymmetry
from depthpose.pose.mesh.symmetry import SymmetryProposal as SymmetryProposal
from depthpose.pose.mesh.symmetry import kept as kept
from depthpose.pose.mesh.symmetry import mirror_deviation as mirror_deviation
from depthpose.pose.mesh.symmetry import near_symmetries as near_symmetries
from depthpose.pose.mesh.symmetry import propose_symmetries as propose_symmetries
from depthpose.pose.mesh.symmetry import symmetries_from_proposals as symmetries_from_proposals
from depthpose.pose.mesh.symmetry import true_symmetries as true_symmetries
from depthpose.pose.mesh.symmetry import with_found_symmetries as with_found_symmetries
