"""From a gmsh mesh to points on surfaces: meshes and tags, facets, rigid surfaces, closest points."""
