"""How is a mesh that does not fit into memory audited: part after part, each with whole neighborhoods?"""
