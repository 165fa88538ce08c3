"""A third-party project without edits of codrl_mj: a family, a task, an agent and a physics."""
