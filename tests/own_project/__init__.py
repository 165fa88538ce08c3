"""A small project of somebody else's, which edits nothing of codrl_mj: a family, a task, an agent and a physics."""
