"""Place recognition, redundant views, loop closing and the atlas of submaps."""
