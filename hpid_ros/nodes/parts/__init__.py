"""Parts of the nodes, of one executable or shared by several."""
