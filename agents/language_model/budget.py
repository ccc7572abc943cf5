"""How many tokens a task may cost, asked and answered."""

from agents.language_model.no_answer import NoAnswer


class Budget:
    """One for each task, such as a commissioning. A call that has begun is paid for, even beyond the most."""

    def __init__(self, most_tokens: int) -> None:
        self.most_tokens = most_tokens
        self.spent_tokens = 0

    def check(self) -> None:
        """Raises NoAnswer where nothing is left."""
        if self.spent_tokens >= self.most_tokens:
            raise NoAnswer(
                "spent", f"this task has used {self.spent_tokens} tokens; agents.task_max_tokens is {self.most_tokens}"
            )

    def spend(self, tokens: int) -> None:
        """`tokens` of a call; of one that failed, as many as it must have cost."""
        self.spent_tokens += tokens
