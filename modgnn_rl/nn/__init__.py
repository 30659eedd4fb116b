"""ModGNN: graphs, communication, aggregation, layers, and the policy that they form."""
