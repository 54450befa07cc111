# Queries of dask arrays: on threads, processes or a cluster, as Dask is set up.
from ._map_queries import map_queries as map_queries
