"""How is a point cloud that does not fit into memory processed: part after part, each with the points around it?"""
